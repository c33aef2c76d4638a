"""What may be wrong at a place that a scan does not explain, told apart by what each cause does to the picture.

A false shape turns normals, and changes shading by its slopes: a dent all around, a badly joined piece along a line. Another albedo changes all light in a spot by
one factor; another gloss changes the mirrored light alone, and so as the lamp's mirror image falls off. The evidence of each (`filters`) is taken for
amounts that are usual of it, and the best explains the place. A shadow is seen as such: far less light than the slope of the surface gets from a lamp
that is there, and less of it around, in the penumbra. Rays tell whether the scan's own surface casts it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.raycast import EmbreeCaster
from rangecheck.recover.fit import Fitted
from rangecheck.recover.grid import JUMP, ScanGrid
from rangecheck.recover.problem import Unknowns
from rangecheck.recover.regions import Region, regions_of
from rangecheck.recover.shading import Shading

#: usual amounts, as standard deviations: of relief, mm;  of ln albedo;  of ln of a lobe's strength and width
RELIEF_MM, PAINT, GLOSS = 1.0, 0.3, 1.0
#: light below this share of what the surface's slope gets is shadow;  deviations below it from which a cell beside is its penumbra
LEAST_SEEN, _PENUMBRA = 0.35, 3.0
#: a lobe that is looked for where none was found: strength, sigma and T in micrometres
_LOBE = {"K_lobe": 0.05, "sigma_um": 0.5, "correlation_um": 5.0}
_NO_LOBE = 0.01
#: causes that change the light of a spot by its own;  share of their evidence that no template is good to
_SPOTS, _ALIKE = ("albedo", "highlight"), 0.01


def shadows(residual: FloatArray, predicted: FloatArray, shone: BoolArray) -> BoolArray:
    """(h, w) cells in shadow and in its penumbra, among those that the lamp should light."""
    from scipy.ndimage import binary_dilation, binary_propagation

    dark = shone & (np.nan_to_num(residual) < math.log(LEAST_SEEN))
    if not dark.any():
        return dark
    rest = shone & ~dark
    around = np.ones((3, 3), bool)
    if not rest.any():
        return dark
    # the picture's noise is the larger a share the less light there is
    bright = float(np.median(predicted[rest]))
    spread = float(np.median(np.abs(residual[rest]))) / 0.6744897501960817
    below = rest & (np.nan_to_num(residual) < -_PENUMBRA * spread * np.maximum(bright / np.where(rest, predicted, 1.0), 1.0))
    # a dark spot of noise has no penumbra, and is none
    return np.asarray(shone & binary_dilation(binary_propagation(dark, around, below | dark), around))


def cast_by_scan(grid: ScanGrid, fitted: Fitted, cells: BoolArray) -> BoolArray:
    """(h, w) those of `cells` from which the scan's own surface hides the lamp."""
    faces = _triangles(grid)
    at = np.flatnonzero(cells)
    hidden = np.zeros(cells.size, bool)
    if len(at) and len(faces):
        points = np.nan_to_num(grid.points.reshape(-1, 3))
        caster = EmbreeCaster(points, faces)
        light = fitted.problem.lights[0]
        start = points[at] - grid.spacing_mm * grid.rays.reshape(-1, 3)[at]
        towards = light.centre_mm - start
        away = np.linalg.norm(towards, axis=1)
        hidden[at] = caster.occluded(start, np.ascontiguousarray(towards / away[:, None]), away - light.radius_mm)
    return hidden.reshape(cells.shape)


def _triangles(grid: ScanGrid) -> np.ndarray:
    """(k, 3) triangles between neighbouring cells on one side of a depth jump."""
    number = np.arange(grid.valid.size).reshape(grid.valid.shape)
    corners = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]], axis=-1).reshape(-1, 4)
    ranges = np.where(grid.valid, np.linalg.norm(grid.points, axis=-1), np.nan).reshape(-1)
    faces = np.concatenate([corners[:, [0, 2, 1]], corners[:, [1, 2, 3]]])
    apart = np.ptp(ranges[faces], axis=1)
    return faces[apart < JUMP * grid.spacing_mm].astype(np.int32)


def gloss_patterns(shading: Shading, cell: np.ndarray, normals: FloatArray, shape: tuple[int, int]) -> list[FloatArray]:
    """(h, w) each: change of ln of the light by ln of the lobe's strength and of its width."""
    problem = shading.problem
    material = problem.material
    if material.K_lobe < _NO_LOBE:
        material = material.but(**_LOBE)
    photo = problem.photographs[0]
    there = replace(photo, sight=replace(photo.sight, normals=normals, facing=normals))
    free = replace(
        problem, photographs=(there,), material=material, unknowns=Unknowns(("K_lobe", "correlation_um"), direction=False)
    )
    shown = free.predict(free.start(), 0)
    patterns: list[FloatArray] = []
    for column in shown.slopes.T:
        full = np.zeros(shape[0] * shape[1])
        full[cell] = column / np.maximum(shown.values, 1e-9)
        patterns.append(full.reshape(shape))
    return patterns


def causes_of(
    wrong: BoolArray, z: FloatArray, evidence: Mapping[str, FloatArray], mirrored: FloatArray, grid: ScanGrid, radius_mm: float
) -> list[Region]:
    """Regions of `wrong` (h, w), each of the cause whose evidence (h, w) is best within twice `radius_mm` of its worst cell; mirrored (h, w): the lobe's
    share of the light.

    A spot in which that share hardly varies is explained by either paint or gloss: then by what has to change less of itself."""
    found = []
    reach = round(2.0 * radius_mm / grid.spacing_mm)
    for region, _ in regions_of(wrong, z, grid.points, grid.spacing_mm, 0.25 * math.pi * (0.5 * radius_mm) ** 2):
        row, column = region.cell
        near = (slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1))
        best = {kind: float(np.nanmax(values[near])) for kind, values in evidence.items()}
        kind = max(best, key=lambda kind: best[kind])
        if kind in _SPOTS and min(best[spot] for spot in _SPOTS) > (1.0 - _ALIKE) * best[kind]:
            kind = "highlight" if mirrored[region.cell] > 0.5 else "albedo"
        found.append(replace(region, kind=kind))
    return found


def shadow_regions(
    shaded: BoolArray, residual: FloatArray, judged: BoolArray, grid: ScanGrid, spread: float, radius_mm: float
) -> list[Region]:
    """Shadows (h, w) beside what is judged, as regions."""
    from scipy.ndimage import binary_dilation

    beside = binary_dilation(judged, iterations=max(1, round(2.5 * radius_mm / grid.spacing_mm)))
    found = regions_of(shaded, np.nan_to_num(residual) / spread, grid.points, grid.spacing_mm, 0.25 * math.pi * radius_mm**2)
    return [replace(region, kind="shadow edge") for region, cells in found if (beside & cells).any()]
