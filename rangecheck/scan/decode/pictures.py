"""One camera's pictures of a sequence of patterns, and the projector coordinates that each pixel saw.

Gray code: each bit as a pattern and its inverse, where either may be missing; phase shift: picture n of N shows
A + B cos(2 pi (coordinate / period - n / N)), and the Gray code, or its bits down to about the period, says which period.

Two things shift the crossings of pattern and inverse, and both are measured and undone, bit by bit: a lamp or shutter that was
brighter for one than for the other, and, where one of the two is missing, the camera's response, which decides how bright the middle of
an edge is. The measure is that crossings of one bit, whose directions alternate, lie halfway between those of other bits on average.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.errors import ScanError
from rangecheck.kernels import in_chunks
from rangecheck.scan.decode.code import coordinates

Picture = npt.NDArray[Any]
#: pictures in order, None where missing, and the period in projector cells
Phase = tuple[Sequence[Picture | None], float]
#: pixels of the Gaussian that quiets sensor noise before crossings are looked for; it shifts none
QUIET_PX = 0.7
#: rounds of balancing: each leaves about a tenth of the offset before it
_ROUNDS = 3
_FEWEST_CROSSINGS = 40
#: of the picture's lines, every so manyth is balanced
_LINES = 4


@dataclass(frozen=True, eq=False)
class Pictures:
    """What one camera took; all pictures (h, w), grey, of one type.

    white, black      projector fully on and off
    column, row       Gray code, most significant bit first: (pattern, inverse), either or both None where missing; row may be empty
    column_phase      phase-shift pictures in order, None where missing, and their period in projector cells; row_phase likewise. Three that
                      are there suffice; with fewer the Gray code stands alone
    full_scale        brightest value a pixel can have"""

    white: Picture = field(repr=False)
    black: Picture = field(repr=False)
    column: Sequence[tuple[Picture | None, Picture | None]] = field(repr=False)
    row: Sequence[tuple[Picture | None, Picture | None]] = field(default=(), repr=False)
    column_phase: Phase | None = field(default=None, repr=False)
    row_phase: Phase | None = field(default=None, repr=False)
    full_scale: float = 255.0
    name: str = "camera"

    def __post_init__(self) -> None:
        shape = self.white.shape
        phases = [p for phase in (self.column_phase, self.row_phase) if phase for p in phase[0] if p is not None]
        every = [self.white, self.black, *phases, *(p for pair in (*self.column, *self.row) for p in pair if p is not None)]
        if self.white.ndim != 2 or any(p.shape != shape for p in every):
            raise ScanError(
                f"{self.name}: pictures have sizes {sorted({p.shape for p in every})}; all must be grey and of one size"
            )
        if not 2 <= len(self.column) <= 16 or len(self.row) > 16:
            raise ScanError(f"{self.name}: {len(self.column)} column and {len(self.row)} row bits; 2 to 16 are decoded")
        for phase in (self.column_phase, self.row_phase):
            if phase and (len(phase[0]) < 3 or not phase[1] > 0):
                raise ScanError(
                    f"{self.name}: {len(phase[0])} phase pictures of period {phase[1]}; at least 3 and a positive period"
                )

    def lost(self) -> list[str]:
        """What is missing, in words."""
        said = []
        for axis, pairs in (("column", self.column), ("row", self.row)):
            for k, (pattern, inverse) in enumerate(pairs):
                if pattern is None and inverse is None:
                    said.append(f"{self.name}: both pictures of {axis} bit {k} are missing; every crossing of that bit is lost")
                elif pattern is None or inverse is None:
                    which = "pattern" if pattern is None else "inverse"
                    said.append(
                        f"{self.name}: the {which} of {axis} bit {k} is missing; rebuilt from white, black and its partner"
                    )
        for axis, phase in (("column", self.column_phase), ("row", self.row_phase)):
            gone = [str(k) for k, picture in enumerate(phase[0]) if picture is None] if phase else []
            if phase and gone:
                rest = "the others are fitted" if _usable(phase) else "too few are left, and the Gray code stands alone"
                said.append(f"{self.name}: phase picture {', '.join(gone)} of {len(phase[0])} of the {axis} is missing; {rest}")
        return said


@dataclass(frozen=True, eq=False)
class Seen:
    """Projector coordinates of a camera's pixels, (h, w) float32, NaN where not known: `column`, `row` (None without row code);
    lit (h, w); faint (h, w) where the finest pictures show no stripes; white contrast (h, w) in 0..1."""

    column: FloatArray
    row: FloatArray | None
    lit: BoolArray
    faint: BoolArray
    contrast: FloatArray


def see_all(cameras: Sequence[Pictures], min_contrast: float) -> list[Seen]:
    """Decode every camera, two codes at a time. Raises ScanError when nothing is lit or nothing can be decoded."""
    lights = [_lit(pictures, min_contrast) for pictures in cameras]
    codes = [(pictures, light, turned) for pictures, light in zip(cameras, lights) for turned in (False, True)]

    def read(i: int, _: int) -> tuple[FloatArray, BoolArray] | None:
        pictures, light, turned = codes[i]
        pairs, phase = (pictures.row, pictures.row_phase) if turned else (pictures.column, pictures.column_phase)
        return _axis(pictures, pairs, phase, *light, turned=turned) if pairs else None

    found = in_chunks(read, len(codes), 1)
    seen = []
    for pictures, (_, _, contrast, lit), column, row in zip(cameras, lights, found[::2], found[1::2]):
        if column is None or not np.isfinite(column[0]).any() or (row is not None and not np.isfinite(row[0]).any()):
            raise ScanError(
                f"{pictures.name}: pixels are lit but no code can be read; check the order of the pictures and their bits"
            )
        faint = column[1] if row is None else column[1] | row[1]
        seen.append(Seen(column[0], None if row is None else row[0], lit, faint & lit, contrast))
    return seen


def _lit(pictures: Pictures, min_contrast: float) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """White and black, quieted, the contrast between them in 0..1, and where it is enough."""
    white, black = (_quiet(p) for p in (pictures.white, pictures.black))
    contrast = (white - black) / np.float32(pictures.full_scale)
    lit = contrast > min_contrast
    if not lit.any():
        raise ScanError(
            f"{pictures.name}: no pixel is {min_contrast:g} of full scale brighter in white than in black; check their order"
        )
    return white, black, contrast, lit


def _axis(
    pictures: Pictures,
    pairs: Sequence[tuple[Picture | None, Picture | None]],
    phase: Phase | None,
    white: FloatArray,
    black: FloatArray,
    contrast: FloatArray,
    lit: BoolArray,
    *,
    turned: bool,
) -> tuple[FloatArray, BoolArray]:
    """Coordinate (h, w) and where its finest stripes are too faint to see."""
    import cv2

    n, missing = len(pairs), 0
    scale = np.float32(pictures.full_scale)

    def turn(a: Any) -> Any:
        if not turned:
            return np.ascontiguousarray(a)
        return cv2.transpose(a.view(np.uint8)).view(bool) if a.dtype == bool else cv2.transpose(a)

    differences = np.zeros((n, *(lit.T.shape if turned else lit.shape)), np.float32)
    for k, (pattern, inverse) in enumerate(pairs):
        if pattern is not None and inverse is not None:
            difference = _quiet(cv2.subtract(pattern, inverse, dtype=cv2.CV_32F))
        elif pattern is not None:
            difference = 2 * _quiet(pattern) - white - black
        elif inverse is not None:
            difference = white + black - 2 * _quiet(inverse)
        else:
            missing |= 1 << (n - 1 - k)
            continue
        difference /= scale
        differences[k] = turn(difference)
    lit, contrast = turn(lit), turn(contrast)
    some, some_lit, some_contrast = (np.ascontiguousarray(a[..., ::_LINES, :]) for a in (differences, lit, contrast))
    balance = np.zeros(n)
    for _ in range(_ROUNDS):
        coordinate, _ = coordinates(some, some_lit, missing)
        offsets = _offsets(some, coordinate, some_contrast)
        for k, offset in enumerate(offsets):
            some[k] += np.float32(offset) * some_contrast
        balance += offsets
    for k, offset in enumerate(balance):
        if offset != 0.0:
            differences[k] += np.float32(offset) * contrast
    coordinate, _ = coordinates(differences, lit, missing)
    finest = next(k for k in range(n - 1, -1, -1) if not (missing >> (n - 1 - k)) & 1)
    swing = cv2.GaussianBlur(np.abs(differences[finest]), (0, 0), 3.0)
    faint = swing < 0.06 * np.maximum(contrast, 1e-3)
    if phase is not None and _usable(phase):
        coordinate = _refined(coordinate, [None if p is None else turn(_quiet(p)) for p in phase[0]], phase[1])
    return turn(coordinate), turn(faint)


def _quiet(picture: Picture) -> FloatArray:
    import cv2

    return cv2.GaussianBlur(picture.astype(np.float32, copy=False), (0, 0), QUIET_PX)


def _usable(phase: Phase) -> bool:
    """Whether brightness, contrast and phase can be told: three unknowns."""
    return sum(picture is not None for picture in phase[0]) >= 3


def _refined(coarse: FloatArray, steps: Sequence[FloatArray | None], period: float) -> FloatArray:
    """Coordinate from the phase of those of N pictures that are there, by least squares; the coarse one only says which period."""
    known = [(2 * math.pi * n / len(steps), picture) for n, picture in enumerate(steps) if picture is not None]
    design = np.array([[1.0, math.cos(angle), math.sin(angle)] for angle, _ in known])
    _, cosines, sines = np.linalg.pinv(design)
    cosine = sum(np.float32(weight) * picture for weight, (_, picture) in zip(cosines, known))
    sine = sum(np.float32(weight) * picture for weight, (_, picture) in zip(sines, known))
    turns = np.arctan2(sine, cosine) / np.float32(2 * math.pi)
    return (np.float32(period) * (turns + np.rint(coarse / np.float32(period) - turns))).astype(np.float32)


def _offsets(differences: FloatArray, lines: FloatArray, contrast: FloatArray) -> FloatArray:
    """Per bit, what to add to its differences, in units of the contrast, so that its crossings lie halfway between those of others.

    A crossing of bit f at boundary k is compared with the mean coordinate one cell to either side, where other bits cross."""
    n = len(differences)
    width = lines.shape[1]
    offsets = np.zeros(n)
    for b in range(n):
        difference = differences[b]
        y, x = np.nonzero((difference[:, :-1] > 0) != (difference[:, 1:] > 0))
        inside = (x > 12) & (x < width - 14)
        y, x = y[inside], x[inside]
        if len(x) < _FEWEST_CROSSINGS:
            continue
        before, after = difference[y, x], difference[y, x + 1]
        at = x + before / (before - after)

        def read(p: FloatArray, y: Any = y) -> FloatArray:
            i = np.clip(np.floor(p).astype(np.int64), 0, width - 2)
            t = p - i
            return (1 - t) * lines[y, i] + t * lines[y, i + 1]

        with np.errstate(invalid="ignore", divide="ignore"):
            here, slope = read(at), (read(at + 3) - read(at - 3)) / 6
            pitch = 1 / np.abs(slope)
            k = np.nan_to_num(np.rint(here)).astype(np.int64)
            own = (k > 0) & ((k & -k) == 1 << (n - 1 - b)) & (np.abs(here - k) < 0.2) & (pitch > 1) & (pitch < 10)
            error = 0.5 * (read(at + np.where(own, pitch, 0)) + read(at - np.where(own, pitch, 0))) - k
            own &= np.abs(error) < 0.5
            shift = error * (after - before) / slope / contrast[y, x]
        if own.sum() >= _FEWEST_CROSSINGS:
            offsets[b] = float(np.median(shift[own]))
    return offsets
