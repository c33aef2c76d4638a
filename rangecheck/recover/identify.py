"""How well the pictures determine what was fitted, and what they do not determine at all.

The information matrix is taken in units in which a change of 1 matters (`Parameter.unit`; a factor e for lengths). Its eigenvectors are
combinations of the parameters that the pictures fix independently of each other; those that they fix no better than `VAGUE` are said
to be undetermined. What stays of the others when these are left open has a variance; a parameter is stated only if it has no share in the open ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.recover.problem import Parameter

#: standard deviation, in units, beyond which a combination counts as not determined
VAGUE = 0.3
#: a parameter whose share in an undetermined combination is smaller than this is still stated
_SHARE = 0.02


class Determination(NamedTuple):
    """covariance (p, p) of the parameters, with undetermined combinations left out;  determined (p,);  open (k, p) the undetermined
    combinations, in units;  statements: what the pictures cannot tell, in words."""

    covariance: FloatArray
    determined: BoolArray
    open: FloatArray
    statements: tuple[str, ...]


def determine(bread: FloatArray, meat: FloatArray, parameters: Sequence[Parameter]) -> Determination:
    """From the information matrix `bread` (p, p) and the scatter of the score `meat` (p, p); equal where noise is as stated.

    Covariance bread^-1 meat bread^-1 (Huber 1967)."""
    units = np.array([p.unit for p in parameters])
    scaled = bread * units[:, None] * units[None, :]
    size, ways = np.linalg.eigh(0.5 * (scaled + scaled.T))
    vague = size < 1.0 / VAGUE**2
    kept = ways[:, ~vague]
    inverse = (kept / size[~vague]) @ kept.T if kept.size else np.zeros_like(scaled)
    spread = inverse @ (meat * units[:, None] * units[None, :]) @ inverse
    covariance = spread * units[:, None] * units[None, :]
    unknown = ways[:, vague].T
    determined = (unknown**2).sum(axis=0) < _SHARE**2 if len(unknown) else np.ones(len(parameters), bool)
    return Determination(covariance, determined, unknown, tuple(_words(unknown, parameters)))


def _words(open_ways: FloatArray, parameters: Sequence[Parameter]) -> list[str]:
    """One sentence for each undetermined combination, the simplest basis of them first."""
    said = []
    for way in _simplest(open_ways):
        share = np.abs(way) / np.abs(way).max()
        named = [int(k) for k in np.argsort(-share, kind="stable") if share[k] > 0.15]
        if len(named) == 1:
            said.append(f"the pictures do not determine {parameters[named[0]].name}")
            continue
        names = [parameters[k].name for k in named]
        moves = ", ".join(f"{parameters[k].name} by {_step(way[k] / way[named[0]], parameters[k])}" for k in named)
        lead = f"the pictures do not tell {' and '.join(names)} apart"
        if len(named) == 2 and all(parameters[k].kind in _BY_RATIO for k in named):
            ratio = way[named[1]] / way[named[0]]
            what = f"{names[0]} / {names[1]}" if ratio > 0 else f"{names[0]} x {names[1]}"
            if abs(abs(ratio) - 1.0) < 0.2:
                lead += f": only {what} acts"
        said.append(f"{lead}; moved together ({moves}) they change nothing that is seen")
    return said


_BY_RATIO = ("length", "log strength", "irradiance", "distance", "radius", "exposure")


def _step(share: float, parameter: Parameter) -> str:
    """A parameter's part of a joint movement."""
    return f"a factor e^{share:+.2f}" if parameter.kind in _BY_RATIO else f"{share * parameter.unit:+.2g}"


def _simplest(ways: FloatArray) -> FloatArray:
    """Another basis of the same combinations in which each names as few parameters as it can: reduced row echelon form by pivots."""
    basis = np.array(ways, dtype=np.float64)
    for row in range(len(basis)):
        rest = basis[row:]
        which, column = divmod(int(np.argmax(np.abs(rest))), rest.shape[1])
        basis[[row, row + which]] = basis[[row + which, row]]
        basis[row] /= basis[row, column]
        for other in range(len(basis)):
            if other != row:
                basis[other] -= basis[other, column] * basis[row]
    return basis
