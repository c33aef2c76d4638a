"""Materials as one flat float64 array, and the inline kernels by which a compiled tracer reads it.

    surfaces, series = stack_tables([plaster, steel])    # two plain arrays; pass both into a kernel

    @kernel
    def shade(surfaces, series, material, wave, c_i, c_r, sxy2):
        return lobe_value(surfaces, series, material, wave, c_i, c_r, sxy2) + lambert_value(surfaces, material, wave)

    with unit vectors to_light, to_viewer and normal:  c_i = to_light.n > 0,  c_r = to_viewer.n > 0,
    h = to_light + to_viewer,  sxy2 = max(0, h.h - (h.n)^2)

`lobe_value` and `lambert_value` are BRDFs per steradian with strengths and Fresnel included; `spike_value` is the factor on the
radiance that arrives along the mirror direction. `sampling.sample_lobe` draws directions for the same lobe.
Every material of one stack is evaluated at the same wavelengths; `wave` counts them in the order of `Material.wavelengths_um`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rangecheck.arrays import FloatArray
from rangecheck.kernels import inline_kernel
from rangecheck.reflectance.energy import VISIBILITY_OCTAVES
from rangecheck.reflectance.fast import lobe_fast
from rangecheck.reflectance.fresnel import FRESNEL_OCTAVES
from rangecheck.reflectance.lobe import ROUGH, SMOOTH, V_GROOVE, lobe_geometry, spike_share, v_groove_masking
from rangecheck.reflectance.octaves import node_count, value_at
from rangecheck.reflectance.series import lobe_rough, lobe_smooth

#: what the last axis of `surfaces` begins with; the tables of visibility and of Fresnel's share follow
K_LM, K_SPIKE, K_LOBE, ROUGHNESS, REACH, MASKING, SIGMA_UM, CORRELATION_UM, WAVELENGTH_UM, FORM = range(10)
VISIBILITY = 16
FRESNEL = VISIBILITY + node_count(VISIBILITY_OCTAVES)
SURFACE_LENGTH = FRESNEL + node_count(FRESNEL_OCTAVES)


class MaterialTables(NamedTuple):
    """All that a tracer needs of its materials, m of them at w wavelengths; float64, C-contiguous, read-only.

    surfaces  (m, w, SURFACE_LENGTH) strengths K_LM, K_SPIKE, K_LOBE in 0..1; roughness and reach as in lobe.py; the masking's
              number; lengths; the number of the lobe's FORM; from VISIBILITY on s(theta) times Smith's masking, from FRESNEL on F against cos^2
    series    the one table of S(g, a), the same for all
    """

    surfaces: FloatArray
    series: FloatArray


@inline_kernel
def lobe_value(surfaces, series, material, wave, c_i, c_r, sxy2):
    """K_lobe F f_lobe in sr^-1, masked and bounded as the material says. Symmetric in c_i and c_r; both must be > 0."""
    reach = surfaces[material, wave, REACH]
    u2 = (c_i + c_r) * (c_i + c_r)
    # what does not wait for the sum is multiplied while that is under way
    value = surfaces[material, wave, K_LOBE] * lobe_geometry(reach, c_i, c_r, sxy2)
    seen = visibility_at(surfaces, material, wave, c_i) * visibility_at(surfaces, material, wave, c_r)
    value *= seen * value_at(surfaces, material, wave, FRESNEL, 0.25 * (u2 + sxy2), FRESNEL_OCTAVES)
    if surfaces[material, wave, MASKING] == V_GROOVE:
        value *= v_groove_masking(c_i, c_r, sxy2)
    g, a = surfaces[material, wave, ROUGHNESS] * u2, reach * sxy2
    form = surfaces[material, wave, FORM]
    if form == SMOOTH:
        return value * lobe_smooth(g, a)
    if form == ROUGH:
        return value * lobe_rough(g, a)
    return value * lobe_fast(series, g, a)


@inline_kernel
def visibility_at(surfaces, material, wave, c):
    """The bound's s(theta) times Smith's masking, in 0..1, for a direction of cosine c."""
    return value_at(surfaces, material, wave, VISIBILITY, c, VISIBILITY_OCTAVES)


@inline_kernel
def fresnel_at(surfaces, material, wave, c):
    """Fresnel's share F at the facet angle of cosine c."""
    return value_at(surfaces, material, wave, FRESNEL, c * c, FRESNEL_OCTAVES)


@inline_kernel
def spike_value(surfaces, material, wave, c_i):
    """K_spike F e^-g at the angle of cosine c_i: what the spike hands on of the radiance along the mirror direction (34)."""
    share = surfaces[material, wave, K_SPIKE] * spike_share(surfaces[material, wave, ROUGHNESS], c_i)
    return share * fresnel_at(surfaces, material, wave, c_i)


@inline_kernel
def lambert_value(surfaces, material, wave):
    """K_lm / pi in sr^-1 (17)."""
    return surfaces[material, wave, K_LM] / math.pi
