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
from rangecheck.reflectance.sampling import lobe_density, scattered_direction, scattering_order
from rangecheck.reflectance.tables import K_LM, K_LOBE, K_SPIKE, REACH, ROUGHNESS, WAVELENGTH_UM, lobe_value, spike_value
from rangecheck.transport.chance import LOBE_WAY, ORDER, key_of, point


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
def draw_lobe(materials, material, cosine, key, number):
    """(x, y, z, density) of a direction drawn for the lobe by scattering order, as `reflectance.sampling` has it: z the normal, the
    viewer at (s, 0, cosine). z = 0: the draw carries nothing."""
    row = materials.surfaces[material, materials.wave]
    wave = materials.wave
    luck, _ = point(key_of(key, ORDER), number)
    p, q = point(key_of(key, LOBE_WAY), number)
    order = scattering_order(4.0 * row[ROUGHNESS] * cosine * cosine, luck, 1)
    x, y, z = scattered_direction(order, row[REACH], cosine, p, q)
    if z <= 0.0:
        return x, y, 0.0, 1.0
    dx = x + math.sqrt(max(0.0, 1.0 - cosine * cosine))
    return x, y, z, lobe_density(materials.surfaces, materials.series, material, wave, cosine, z, dx * dx + y * y)
