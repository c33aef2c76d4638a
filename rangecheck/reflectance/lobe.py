"""The specular lobe and spike from direction cosines, with masking: the equations that a tracer and the public functions share.

Both directions point away from the surface; c_i, c_r > 0 are their cosines to the normal, and sxy2 = s_xy^2 is the squared length
of the tangential part of their sum: with unit vectors h = to_light + to_viewer, sxy2 = h.h - (h.n)^2 and c_i + c_r = h.n.
No angle is needed, and nothing tells one direction from the other, so reciprocity holds to the last bit.

Two numbers describe the surface, both without unit, lengths in micrometres inside the ratios:

    roughness = (2 pi sigma / lambda)^2     g = roughness (c_i + c_r)^2                      (2)
    reach     = (pi T / lambda)^2           a = reach sxy2

and with 1 + c_i c_r - s_i s_r cos phi = ((c_i + c_r)^2 + sxy2)/2 the lobe (1), (4), (9), (12) becomes

    f = reach/(4 pi) ((c_i + c_r)^2 + sxy2)^2 / (c_i + c_r)^2  S(g, a) / (c_i c_r)     per steradian

Masking: Smith 1967 for the Gaussian slopes of the rough limit, rms slope alpha = 2 sigma/T, each direction on its own, as in Walter et
al. 2007; V-grooves: Torrance & Sparrow 1967.
"""

from __future__ import annotations

import math
from typing import Any

from rangecheck.kernels import inline_kernel, kernel
from rangecheck.reflectance.series import lobe_rough, lobe_series, lobe_smooth

SERIES, SMOOTH, ROUGH, FAST = 0, 1, 2, 3
FORMS = {"series": SERIES, "smooth": SMOOTH, "rough": ROUGH, "fast": FAST}
UNMASKED, SMITH, V_GROOVE = 0, 1, 2
MASKINGS = {"none": UNMASKED, "smith": SMITH, "v-groove": V_GROOVE}


def two_numbers(sigma_um: Any, correlation_um: Any, wavelength_um: Any) -> tuple[Any, Any]:
    """(roughness, reach) of a surface; arrays are as welcome as numbers."""
    return (2.0 * math.pi * sigma_um / wavelength_um) ** 2, (math.pi * correlation_um / wavelength_um) ** 2


@inline_kernel
def lobe_geometry(reach, c_i, c_r, sxy2):
    """What multiplies S(g, a) in the lobe, per steradian."""
    u2 = (c_i + c_r) * (c_i + c_r)
    h2 = u2 + sxy2
    return reach / (4.0 * math.pi) * (h2 * h2) / (u2 * (c_i * c_r))


@kernel
def scattering_sum(form, roughness, reach, c_i, c_r, sxy2):
    """S(g, a) by the general, smooth or rough form."""
    g, a = roughness * (c_i + c_r) * (c_i + c_r), reach * sxy2
    if form == SMOOTH:
        return lobe_smooth(g, a)
    if form == ROUGH:
        return lobe_rough(g, a)
    return lobe_series(g, a)


@kernel
def smith_masking(c, rms_slope):
    """Share of the facets seen from a direction of cosine c that no other facet hides; rms_slope = 2 sigma/T."""
    if c <= 0.0:
        return 0.0
    tangent = math.sqrt(max(0.0, 1.0 - c * c)) / c
    if rms_slope * tangent < 1e-8:
        return 1.0
    b = 1.0 / (rms_slope * tangent)
    if b > 6.0:
        return 1.0
    return 2.0 / (1.0 + math.erf(b) + math.exp(-b * b) / (b * math.sqrt(math.pi)))


@inline_kernel
def v_groove_masking(c_i, c_r, sxy2):
    """Share of a V-groove's facet that is both lit and seen: min(1, 2 (n.h)(n.w)/(w.h)) for the lower of the two directions."""
    u = c_i + c_r
    return min(1.0, 4.0 * u * min(c_i, c_r) / (u * u + sxy2))


@inline_kernel
def spike_share(roughness, c_i):
    """Share of the light that stays in the mirror direction: e^-g at the specular angle (14), g = (4 pi sigma c_i/lambda)^2."""
    return math.exp(-4.0 * roughness * c_i * c_i)
