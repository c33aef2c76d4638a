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
from rangecheck.reflectance.lobe import smith_masking
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

#: roughness g at normal incidence above which a lobe is also drawn from its slopes
_SEVERAL_ORDERS = 4.0
#: the most of the draws that are made from slopes, and how many more of the rest take the order of light from the zenith
_MOST_SLOPES, _STEEP_SHARE = 0.9, 0.2


class Materials(NamedTuple):
    """surfaces, series as of `reflectance.MaterialTables`; shiny (m,) bool: has a spike or a lobe; wave: the wavelength lobes are
    drawn at, the longest, because its lobe is the widest and so no other's weight grows without bound."""

    surfaces: FloatArray
    series: FloatArray
    shiny: BoolArray
    wave: int


def materials_of(materials: Sequence[Material]) -> Materials:
    """The scene's materials for the stages."""
    tables = stack_tables(materials)
    shiny = np.asarray((tables.surfaces[:, :, [K_SPIKE, K_LOBE]] > 0).any(axis=(1, 2)))
    return Materials(tables.surfaces, tables.series, shiny, int(np.argmax(tables.surfaces[0, :, WAVELENGTH_UM])))


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
def seen_slope(tangent, u):
    """The slope towards a viewer, of width 1, below which a share u of the facets lies that are seen from an angle of this tangent:
    density (1 + t tangent) e^-t^2 for t > -1/tangent (Heitz & d'Eon 2014), inverted by Newton's method inside a bracket."""
    normal = normal_quantile(min(max(u, 1e-12), 1.0 - 1e-12)) * math.sqrt(0.5)
    if tangent < 1e-5:
        return normal
    low, high = max(-1.0 / tangent, -5.5), 5.5
    root = tangent / math.sqrt(math.pi)
    below = math.erf(low) - root * math.exp(-low * low)
    total = 1.0 - below
    steep = tangent / (1.0 + tangent)
    # from all facets alike to only those that grow with their slope
    t = (1.0 - steep) * normal + steep * math.sqrt(-math.log1p(-min(max(u, 1e-12), 1.0 - 1e-12)))
    t = min(max(t, low), high)
    for _ in range(24):
        fall = math.exp(-t * t)
        over = math.erf(t) - root * fall - below - u * total
        if over > 0.0:
            high = t
        else:
            low = t
        rise = 2.0 / math.sqrt(math.pi) * (1.0 + t * tangent) * fall
        step = over / rise if rise > 0.0 else 2.0 * (high - low)
        after = t - step
        if not low < after < high:
            after = 0.5 * (low + high)
        moved, t = abs(after - t), after
        if moved < 1e-7:
            break
    return t


@stage_kernel
def slope_density(alpha, cos_i, cos_r, toward):
    """Density per steradian of directions mirrored by facets of Gaussian slopes, as many as are seen from cos_r: D G1/(4 cos_r)."""
    height2 = 2.0 * (1.0 + toward)
    both = cos_i + cos_r
    if not (height2 > 0.0 and both > 0.0):
        return 0.0
    cos2 = min(1.0, both * both / height2)
    alpha2 = alpha * alpha
    # the cosine in the denominator is the viewer's, which masking takes along to 0
    seen = smith_masking(max(cos_r, 1e-9), alpha) / max(cos_r, 1e-9)
    return seen * math.exp((1.0 - 1.0 / cos2) / alpha2) / (4.0 * math.pi * alpha2 * cos2 * cos2)


@stage_kernel
def draw_lobe(materials, material, cosine, key, number):
    """(x, y, z, density) of a direction drawn for the lobe: z the normal, the viewer at (s, 0, cosine). z <= 0: it carries nothing.

    By scattering order, as `reflectance.sampling` has it. But seen at grazing angles a surface scatters upwards far more often than its
    order at the mirror angle says: so some directions are drawn with the order that light from the zenith would have, and on surfaces
    of several orders most are mirrored by visible facets (Heitz & d'Eon, *Importance sampling microfacet-based BSDFs using the
    distribution of visible normals*, 2014), whose weight is the masking of the direction that is drawn. The density is that of all together (Veach & Guibas 1995), so that no weight grows large."""
    row = materials.surfaces[material, materials.wave]
    luck, which = point(key_of(key, ORDER), number)
    p, q = point(key_of(key, LOBE_WAY), number)
    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
    share = _slope_share(materials, material)
    steeply = _STEEP_SHARE * (1.0 - share * share)
    if which < share:
        alpha = _slopes(materials, material)
        turned = alpha * normal_quantile(min(max(q, 1e-12), 1.0 - 1e-12)) * math.sqrt(0.5)
        lean = alpha * seen_slope(alpha * sine / max(cosine, 1e-9), p)
        size = math.sqrt(lean * lean + turned * turned + 1.0)
        twice = 2.0 * (sine * lean + cosine) / (size * size)
        x, y, z = twice * lean - sine, twice * turned, twice - cosine
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
        density += share * slope_density(_slopes(materials, material), z, cosine, sine * x + cosine * z)
    return x, y, z, density
