"""Light that lamps do not send straight to the pixels' surface: of the surroundings, and what other parts throw and mirror. Only a simulator knows it,
and only near a state: its values there, and how they change with what is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray, IntArray

#: material numbers on which it depends: K_lm, K_spike, K_lobe, and the logarithms of sigma and T
NUMBERS = 5


@dataclass(frozen=True, eq=False)
class Thrown:
    """Radiance beside the lamps' straight light, at exposure 1.

    at       (5,) the NUMBERS of the material that it was simulated with
    values   (n,) of the pixels there;  slopes (n, 5) by the numbers
    by_pose  (n, 6) by the camera's turn and shift, as `Sight.by_pose` counts them; zero where that was not simulated
    """

    at: FloatArray
    values: FloatArray
    slopes: FloatArray
    by_pose: FloatArray

    @classmethod
    def none(cls, n: int) -> Thrown:
        """No such light on n pixels."""
        return cls(np.zeros(NUMBERS), np.zeros(n), np.zeros((n, NUMBERS)), np.zeros((n, 6)))

    def only(self, keep: IntArray | BoolArray) -> Thrown:
        """Of these pixels."""
        return Thrown(self.at, self.values[keep], self.slopes[keep], self.by_pose[keep])

    def near(self, numbers: Sequence[float], pose: FloatArray) -> FloatArray:
        """(n,) where the material has these NUMBERS and the camera is moved by `pose` (6,)."""
        return np.asarray(self.values + self.slopes @ (np.asarray(numbers) - self.at) + self.by_pose @ pose)
