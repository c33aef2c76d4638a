"""What the tracer needs to know of its materials, beside their tables: which mirror at all, and how lobes are drawn.

With unit vectors wi, wr to where light comes from and goes to, and h = wi + wr, whose length is |h|^2 = 2 (1 + wi.wr), the squared
tangential part of h is s_xy^2 = 2 (1 + wi.wr) - (c_i + c_r)^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rangecheck.arrays import BoolArray, FloatArray
from rangecheck.kernels import stage_kernel
from rangecheck.reflectance import Material, stack_tables
from rangecheck.reflectance.sampling import lobe_density, normal_quantile, scattered_direction, scattering_order
from rangecheck.reflectance.tables import (
    CORRELATION_UM,
    K_LM,
    K_LOBE,
    K_SPIKE,
    REACH,
    ROUGHNESS,
    SIGMA_UM,
    WAVELENGTH_UM,
    lobe_value,
    spike_value,
)
from rangecheck.transport.chance import LOBE_WAY, ORDER, key_of, point
from rangecheck.transport.slopes import seen_slope, slope_density, slope_table

#: roughness g at normal incidence above which a lobe is also drawn from its slopes, and from which on it is drawn from slopes alone
_SEVERAL_ORDERS, _MANY_ORDERS = 4.0, 64.0
#: the most of the draws that are made from slopes where orders are drawn too, and how many more of the rest take the order of light from the zenith
_MOST_SLOPES, _STEEP_SHARE = 0.9, 0.2
#: where slopes are drawn alone, the lobe's tails, which are thicker than a Gaussian's by one part in g, are met by slopes so many times as wide;
#: the share of these at the least roughness
_WIDER, _WIDE_SHARE = 1.5, 0.08


class Materials(NamedTuple):
    """surfaces, series as of `reflectance.MaterialTables`; shiny (m,) bool: has a spike or a lobe; wave: the wavelength lobes are
    drawn at, the longest, because its lobe is the widest and so no other's weight grows without bound; slopes: as of `slopes.slope_table`."""

    surfaces: FloatArray
    series: FloatArray
    shiny: BoolArray
    wave: int
    slopes: FloatArray


def materials_of(materials: Sequence[Material]) -> Materials:
    """The scene's materials for the stages."""
    tables = stack_tables(materials)
    shiny = np.asarray((tables.surfaces[:, :, [K_SPIKE, K_LOBE]] > 0).any(axis=(1, 2)))
    return Materials(tables.surfaces, tables.series, shiny, int(np.argmax(tables.surfaces[0, :, WAVELENGTH_UM])), slope_table())


@stage_kernel
def aside2(cos_i, cos_r, toward):
    """s_xy^2 of two directions with these cosines and wi.wr = toward."""
    both = cos_i + cos_r
    return max(0.0, 2.0 * (1.0 + toward) - both * both)


@stage_kernel
def lobe_of(materials, material, wave, cos_i, cos_r, toward):
    """BRDF of the lobe in sr^-1; 0 below the horizon."""
    if cos_i <= 0.0 or cos_r <= 0.0:
        return 0.0
    return lobe_value(materials.surfaces, materials.series, material, wave, cos_i, cos_r, aside2(cos_i, cos_r, toward))


@stage_kernel
def spike_of(materials, material, wave, cosine):
    """Reflectance of the spike, equation (34)."""
    return spike_value(materials.surfaces, material, wave, cosine)


@stage_kernel
def lobe_guess(materials, material, wave, cosine):
    """About how much the lobe reflects: what the spike does not. Good enough to choose by, not to weigh with."""
    roughness = materials.surfaces[material, wave, ROUGHNESS]
    return materials.surfaces[material, wave, K_LOBE] * -math.expm1(-4.0 * roughness * cosine * cosine)


@stage_kernel
def diffuse_of(materials, material, wave):
    """K_lm."""
    return materials.surfaces[material, wave, K_LM]


@stage_kernel
def _slope_share(materials, material):
    """With which probability a lobe is drawn from its slopes instead of by scattering order: the more, the nearer to the rough limit."""
    roughness = 4.0 * materials.surfaces[material, materials.wave, ROUGHNESS]
    return _MOST_SLOPES * roughness / (roughness + _SEVERAL_ORDERS) if roughness > _SEVERAL_ORDERS else 0.0


@stage_kernel
def _slopes(materials, material):
    """Width of the slopes drawn from: alpha = 2 sigma/T, the rough limit's."""
    row = materials.surfaces[material, materials.wave]
    return 2.0 * row[SIGMA_UM] / row[CORRELATION_UM]


@stage_kernel
def _mirrored_by_slopes(table, alpha, sine, cosine, x, around):
    """(x, y, z) mirrored by a facet whose slopes stand for two Gaussian quantiles."""
    lean = alpha * seen_slope(table, alpha * sine / (cosine + alpha * sine), x)
    turned = alpha * around
    twice = 2.0 * (sine * lean + cosine) / (lean * lean + turned * turned + 1.0)
    return twice * lean - sine, twice * turned, twice - cosine


@stage_kernel
def _quantile(p):
    """The Gaussian quantile of a number in [0, 1), for the density e^-t^2."""
    return normal_quantile(min(max(p, 1e-12), 1.0 - 1e-12)) * math.sqrt(0.5)


@stage_kernel
def draw_lobe(materials, material, cosine, key, number):
    """(x, y, z, density) of a direction drawn for the lobe: z the normal, the viewer at (s, 0, cosine). z <= 0: it carries nothing.

    On surfaces of many scattering orders it is mirrored by a visible facet, whose weight is the masking of the direction that is drawn; a
    few facets are drawn from wider slopes. On smoother ones it is drawn by scattering order, as `reflectance.sampling` has it. But seen
    at grazing angles a surface scatters upwards far more often than its order at the mirror angle says: so some directions are drawn with
    the order that light from the zenith would have, and on surfaces of several orders some from slopes. The density is that of all
    together (Veach & Guibas 1995), so that no weight grows large."""
    row = materials.surfaces[material, materials.wave]
    p, q = point(key_of(key, LOBE_WAY), number)
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    roughness = 4.0 * row[ROUGHNESS]
    alpha = _slopes(materials, material)
    if roughness >= _MANY_ORDERS:
        # one of the two numbers also chooses the width, so that all draws together stay evenly spread
        wide = _WIDE_SHARE * _MANY_ORDERS / roughness
        spread = p < wide
        p = p / wide if spread else (p - wide) / (1.0 - wide)
        width = alpha * _WIDER if spread else alpha
        x, y, z = _mirrored_by_slopes(materials.slopes, width, sine, cosine, _quantile(p), _quantile(q))
        if not z > 0.0:
            return x, y, 0.0, 1.0
        toward = sine * x + cosine * z
        density = (1.0 - wide) * slope_density(materials.slopes, alpha, sine, z, cosine, toward)
        density += wide * slope_density(materials.slopes, alpha * _WIDER, sine, z, cosine, toward)
        return x, y, z, density
    luck, which = point(key_of(key, ORDER), number)
    share = _slope_share(materials, material)
    steeply = _STEEP_SHARE * (1.0 - share * share)
    if which < share:
        x, y, z = _mirrored_by_slopes(materials.slopes, alpha, sine, cosine, _quantile(p), _quantile(q))
    else:
        cosines = 1.0 + cosine if which < share + steeply else 2.0 * cosine
        order = scattering_order(row[ROUGHNESS] * cosines * cosines, luck, 1)
        x, y, z = scattered_direction(order, row[REACH], cosine, p, q)
    if not z > 0.0:
        return x, y, 0.0, 1.0
    dx = x + sine
    aside = dx * dx + y * y
    flat = lobe_density(materials.surfaces, materials.series, material, materials.wave, cosine, z, aside)
    steep = lobe_density(materials.surfaces, materials.series, material, materials.wave, 0.5 * (1.0 + cosine), z, aside)
    density = (1.0 - share - steeply) * flat + steeply * steep
    if share > 0.0:
        density += share * slope_density(materials.slopes, alpha, sine, z, cosine, sine * x + cosine * z)
    return x, y, z, density
