"""How far the smooth and the rough form of a surface's lobe are from the general one, so that the cheaper may be chosen where it serves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from rangecheck.reflectance.fast import FAST_ERROR
from rangecheck.reflectance.lobe import FORMS, two_numbers
from rangecheck.reflectance.material import Material
from rangecheck.reflectance.series import lobe_rough, lobe_series, lobe_smooth
from rangecheck.reflectance.tables import FORM, MaterialTables

#: directions up to this many degrees from the normal are judged; beyond, every form of the published model fails alike
JUDGED_TO_DEG = 80.0
_WIDTHS, _STEPS = 12.0, 33


def form_error(form: str, material: Material) -> float:
    """Largest difference of `form` (smooth, rough, fast or series) from the series, relative to the lobe's peak at the same g, over the g
    that this surface shows up to JUDGED_TO_DEG and all directions around the mirror's. 0 for a surface without a lobe."""
    if form in ("fast", "series"):
        return FAST_ERROR if form == "fast" else 0.0
    if not material.sigma_um > 0.0:
        return 0.0
    numbers = [two_numbers(material.sigma_um, material.correlation_um, wave)[0] for wave in material.wavelengths_um]
    return max(_largest(form, 4.0 * float(roughness)) for roughness in numbers)


@lru_cache(maxsize=256)
def _largest(form: str, most: float) -> float:
    least = most * math.cos(math.radians(JUDGED_TO_DEG)) ** 2
    evaluate = lobe_smooth if form == "smooth" else lobe_rough
    worst = 0.0
    for g in np.geomspace(least, most, 9):
        peak = lobe_series(g, 0.0)
        for a in np.linspace(0.0, _WIDTHS * (1.0 + g), _STEPS):
            worst = max(worst, abs(evaluate(g, a) - lobe_series(g, a)) / peak)
    return worst


def with_forms(tables: MaterialTables, forms: Sequence[str]) -> MaterialTables:
    """The same materials, material m's lobe evaluated by forms[m]: smooth, rough or fast."""
    surfaces = tables.surfaces.copy()
    for m, form in enumerate(forms):
        surfaces[m, :, FORM] = FORMS[form]
    surfaces.flags.writeable = False
    return tables._replace(surfaces=surfaces)
