"""Where the surface that no scan has seen may be expected: halfway between what was measured and the space that is known to be empty.

The frontier of the unknown is no surface: behind scans from one side it is a prism as deep as the box, whose walls lie where the scanners'
rays passed, and it looks largest from where there is least to see. Here unknown cells take the potential of a conductor between measured
cells at 1 and empty ones at 0, by Laplace's equation; where it is above a half, the object is expected. The space with the other unknown
cells emptied has the expected surface for its frontier.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import kernel
from rangecheck.scan.quality_space import EMPTY, MEASURED, UNKNOWN, Space

#: largest change of a potential in a sweep at which it counts as settled, and most sweeps
_SETTLED, _SWEEPS = 1e-3, 400


def expected(space: Space) -> Space:
    """The same space, with unknown cells only where the object is expected."""
    potential = (space.state == MEASURED).astype(np.float32)
    free = space.state == UNKNOWN
    # the best factor of over-relaxation for a cube of that many cells
    factor = 2.0 / (1.0 + math.sin(math.pi / max(space.state.shape)))
    for _ in range(_SWEEPS):
        if relax(potential, free, np.float32(factor)) < _SETTLED:
            break
    state = space.state.copy()
    state[free & (potential < 0.5)] = EMPTY
    return Space(state, space.corner_mm, space.cell_mm)


@kernel
def relax(potential, free, factor):
    """One sweep of over-relaxation (Young 1954) in place; outside the box the potential is 0. The largest change."""
    nx, ny, nz = potential.shape
    largest = 0.0
    for i in range(nx):
        for j in range(ny):
            for k in range(nz):
                if not free[i, j, k]:
                    continue
                around = np.float32(0.0)
                if i > 0:
                    around += potential[i - 1, j, k]
                if i < nx - 1:
                    around += potential[i + 1, j, k]
                if j > 0:
                    around += potential[i, j - 1, k]
                if j < ny - 1:
                    around += potential[i, j + 1, k]
                if k > 0:
                    around += potential[i, j, k - 1]
                if k < nz - 1:
                    around += potential[i, j, k + 1]
                change = factor * (around / np.float32(6.0) - potential[i, j, k])
                potential[i, j, k] += change
                largest = max(largest, abs(change))
    return largest
