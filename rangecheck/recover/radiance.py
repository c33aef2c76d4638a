"""Radiance that a point sends to the camera straight from spherical sources, with its exact derivatives.

    L = K_lm F_form L_s  +  K_spike F e^-g C L_s  +  K_lobe sum over the source of F f_lobe cos L_s      (18)-(22), (34)

World frame, millimetres. F_form is the sphere's form factor, exact also where the horizon cuts it. C is the share of the pixel's mirrored
footprint that the source fills: a disc of the footprint's solid angle against the source's disc, so that a highlight's energy does not
depend on the pixel's size and C has a slope. The lobe is taken at nodes spread over the source; with one node, at its middle, as the
tracer does without soft shadows. Both mirror Fresnel's share F where the metal's n and k are known; else facets are perfect conductors
(F = 1: a strength recovered from pictures then holds Fresnel's share). The bound of `reflectance.energy` is left out: it scales the
lobe by less than 1 % below 70 degrees, where pictures are compared.

All derivatives are by hand, source by source, for unit source radiance; visibility is held.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import inline_kernel, kernel
from rangecheck.recover.series_slopes import log_series_and_slopes
from rangecheck.reflectance.fresnel import conductor_fresnel_slope
from rangecheck.reflectance.lobe import SMITH, V_GROOVE

#: the order of the derivatives with respect to the material; lengths enter by their logarithms
D_K_LM, D_K_SPIKE, D_K_LOBE, D_LN_SIGMA, D_LN_CORRELATION = range(5)
MATERIAL_NUMBERS = 5
_ROOT_PI = math.sqrt(math.pi)
#: a/(4 + g) above which the lobe is less than e^-50 of its peak and taken as dark
_DARK = 60.0


@kernel
def form_factor_slopes(cosine, sine2):
    """(F, dF/dcosine, dF/dsine2) of `scene.sources.form_factor`."""
    if cosine * cosine > sine2:
        return (sine2 * cosine, sine2, cosine) if cosine > 0.0 else (0.0, 0.0, 0.0)
    sine = math.sqrt(max(1e-300, 1.0 - cosine * cosine))
    y = math.sqrt(max(0.0, 1.0 / sine2 - 1.0))
    arc = math.acos(max(-1.0, min(1.0, -y * cosine / sine)))
    root = math.sqrt(max(0.0, 1.0 - cosine * cosine / sine2))
    factor = ((cosine * arc - y * root) * sine2 + math.atan2(root, y)) / math.pi
    by_cosine = sine2 * (arc + y * cosine * root / (sine * sine)) / math.pi
    by_sine2 = (cosine * arc + root / max(y, 1e-300)) / math.pi
    return max(0.0, factor), by_cosine, by_sine2


@kernel
def masking_slopes(c, rms_slope):
    """(ln M, d ln M / dc, d ln M / d ln rms_slope) of Smith's masking."""
    s2 = 1.0 - c * c
    if s2 <= 0.0 or rms_slope * math.sqrt(s2) < 1e-8 * c:
        return 0.0, 0.0, 0.0
    s = math.sqrt(s2)
    b = c / (rms_slope * s)
    if b > 6.0:
        return 0.0, 0.0, 0.0
    tail = math.exp(-b * b)
    whole = 1.0 + math.erf(b) + tail / (b * _ROOT_PI)
    slope = tail / (b * b * _ROOT_PI) / whole
    return math.log(2.0 / whole), slope / (rms_slope * s * s2), -slope * b


@kernel
def disc_share(apart, source, pixel):
    """(share, d/dapart, d/dsource, d/dpixel) of a disc of radius `pixel` that a disc of radius `source` covers, their middles `apart`."""
    whole = math.pi * pixel * pixel
    if apart >= source + pixel:
        return 0.0, 0.0, 0.0, 0.0
    if apart <= abs(source - pixel):
        if source >= pixel:
            return 1.0, 0.0, 0.0, 0.0
        share = (source / pixel) ** 2
        return share, 0.0, 2.0 * source / (pixel * pixel), -2.0 * share / pixel
    p = max(-1.0, min(1.0, (apart * apart + source * source - pixel * pixel) / (2.0 * apart * source)))
    q = max(-1.0, min(1.0, (apart * apart + pixel * pixel - source * source) / (2.0 * apart * pixel)))
    chord = (
        math.sqrt(
            max(0.0, (source + pixel - apart) * (apart + source - pixel) * (apart - source + pixel) * (apart + source + pixel))
        )
        / apart
    )
    arc, own_arc = math.acos(p), math.acos(q)
    share = (source * source * arc + pixel * pixel * own_arc - 0.5 * apart * chord) / whole
    return share, -chord / whole, 2.0 * source * arc / whole, 2.0 * (pixel * own_arc / whole - share / pixel)


@inline_kernel
def _add(out, i, s, x, y, z):
    out[i, s, 0] += x
    out[i, s, 1] += y
    out[i, s, 2] += z


@kernel
def _lobe_node(
    i, s, masking, k_lobe, roughness, reach, rms_slope, index, n, v, c_r, qx, qy, qz, weight, radius,
    value, by_material, by_point, by_normal, by_view, towards,
):  # fmt: skip
    """Add what the node at offset q gives; `towards` (3,) gets the derivative by the node's place."""
    towards[0] = towards[1] = towards[2] = 0.0
    d2 = qx * qx + qy * qy + qz * qz
    d = math.sqrt(d2)
    wx, wy, wz = qx / d, qy / d, qz / d
    c_i = wx * n[0] + wy * n[1] + wz * n[2]
    if c_i <= 0.0:
        return 0.0
    height2 = 2.0 * (1.0 + wx * v[0] + wy * v[1] + wz * v[2])
    u = c_i + c_r
    aside = max(0.0, height2 - u * u)
    g, a = roughness * u * u, reach * aside
    if a > _DARK * (4.0 + g):
        return 0.0
    log_s, by_ln_g, by_a = log_series_and_slopes(g, a)
    ln_f = math.log(reach / (4.0 * math.pi)) + 2.0 * math.log(height2 / u) - math.log(c_r) + log_s
    by_h2 = 2.0 / height2 + by_a * reach
    by_u = (-2.0 + 2.0 * by_ln_g) / u - 2.0 * by_a * reach * u
    by_ci, by_cr = 0.0, -1.0 / c_r
    by_ln_sigma, by_ln_t = 2.0 * by_ln_g, 2.0 + 2.0 * by_a * a
    if masking == SMITH:
        ln_i, slope_i, alpha_i = masking_slopes(c_i, rms_slope)
        ln_r, slope_r, alpha_r = masking_slopes(c_r, rms_slope)
        ln_f += ln_i + ln_r
        by_ci += slope_i
        by_cr += slope_r
        by_ln_sigma += alpha_i + alpha_r
        by_ln_t -= alpha_i + alpha_r
    elif masking == V_GROOVE:
        lower = min(c_i, c_r)
        groove = 4.0 * u * lower / height2
        if groove < 1.0:
            ln_f += math.log(groove)
            by_u += 1.0 / u
            by_h2 -= 1.0 / height2
            if c_i < c_r:
                by_ci += 1.0 / c_i
            else:
                by_cr += 1.0 / c_r
    if index[0] > 0.0:
        c_facet = 0.5 * math.sqrt(height2)
        share, slope = conductor_fresnel_slope(min(c_facet, 1.0), index[0], index[1])
        ln_f += math.log(share)
        by_h2 += slope / share / (8.0 * c_facet)
    light = weight * math.pi * radius * radius / d2 * math.exp(ln_f)
    value[i, s] += k_lobe * light
    by_material[i, s, D_K_LOBE] += light
    light *= k_lobe
    by_material[i, s, D_LN_SIGMA] += light * by_ln_sigma
    by_material[i, s, D_LN_CORRELATION] += light * by_ln_t
    ox = 2.0 * by_h2 * v[0] + (by_u + by_ci) * n[0]
    oy = 2.0 * by_h2 * v[1] + (by_u + by_ci) * n[1]
    oz = 2.0 * by_h2 * v[2] + (by_u + by_ci) * n[2]
    along = ox * wx + oy * wy + oz * wz + 2.0
    towards[0], towards[1], towards[2] = (
        light * (ox - along * wx) / d, light * (oy - along * wy) / d, light * (oz - along * wz) / d,
    )  # fmt: skip
    _add(by_point, i, s, -towards[0], -towards[1], -towards[2])
    on_light, on_view = light * (by_u + by_ci), light * (by_u + by_cr)
    _add(by_normal, i, s, on_light * wx + on_view * v[0], on_light * wy + on_view * v[1], on_light * wz + on_view * v[2])
    on_half = 2.0 * light * by_h2
    _add(by_view, i, s, on_half * wx + on_view * n[0], on_half * wy + on_view * n[1], on_half * wz + on_view * n[2])
    return light


@kernel
def shade(
    masking, strengths, roughness, reach, index, points, normals, views, footprints, lit, centres, radii, frames, frame_slopes, nodes,
    start, stop, value, by_material, by_centre, by_radius, by_point, by_normal, by_view, by_footprint,
):  # fmt: skip
    """Radiance of pixels start..stop from each source at unit radiance, and its derivatives, into arrays of their own rows.

    masking       number of lobe.MASKINGS
    strengths     (3,) K_lm, K_spike, K_lobe;  roughness, reach  as in reflectance.lobe;  index (2,) n, k; n = 0: a perfect conductor
    points, normals, views  (n, 3): place, unit normal, unit direction to the camera;  footprints (n,): angular radius of the disc as large
                  as the pixel's mirrored footprint, rad
    lit           (n, s) uint8, 0 where the source is hidden
    centres (s, 3), radii (s,);  frames (s, 2, 3): two unit vectors across the source;  frame_slopes (s, 2, 3, 3): their derivatives by
                  the centre;  nodes (q, 3): place in the unit disc and weight, weights adding to 1
    value (n, s); by_material (n, s, 5); by_centre (n, s, 3); by_radius (n, s); by_point, by_normal, by_view (n, s, 3); by_footprint (n, s)
    """
    rms_slope = math.sqrt(roughness / reach)
    k_lm, k_spike, k_lobe = strengths[0], strengths[1], strengths[2]
    towards = np.zeros(3)
    for row in range(start, stop):
        i = row - start
        n, v, x = normals[row], views[row], points[row]
        c_r = v[0] * n[0] + v[1] * n[1] + v[2] * n[2]
        for s in range(len(radii)):
            value[i, s] = by_radius[i, s] = by_footprint[i, s] = 0.0
            by_material[i, s, :] = 0.0
            by_centre[i, s, :] = 0.0
            by_point[i, s, :] = 0.0
            by_normal[i, s, :] = 0.0
            by_view[i, s, :] = 0.0
            if lit[row, s] == 0 or c_r <= 0.0:
                continue
            r = radii[s]
            qx, qy, qz = centres[s, 0] - x[0], centres[s, 1] - x[1], centres[s, 2] - x[2]
            d2 = qx * qx + qy * qy + qz * qz
            d = math.sqrt(d2)
            wx, wy, wz = qx / d, qy / d, qz / d
            c_i = wx * n[0] + wy * n[1] + wz * n[2]
            sine2 = min(1.0, r * r / d2)

            factor, by_c, by_s2 = form_factor_slopes(c_i, sine2)
            value[i, s] += k_lm * factor
            by_material[i, s, D_K_LM] = factor
            by_c, by_s2 = k_lm * by_c, k_lm * by_s2
            along = by_c * c_i + 2.0 * sine2 * by_s2
            gx, gy, gz = (by_c * n[0] - along * wx) / d, (by_c * n[1] - along * wy) / d, (by_c * n[2] - along * wz) / d
            _add(by_centre, i, s, gx, gy, gz)
            _add(by_point, i, s, -gx, -gy, -gz)
            _add(by_normal, i, s, by_c * wx, by_c * wy, by_c * wz)
            by_radius[i, s] += by_s2 * 2.0 * r / d2

            if footprints[row] > 0.0 and c_i > 0.0:
                mx, my, mz = 2.0 * c_r * n[0] - v[0], 2.0 * c_r * n[1] - v[1], 2.0 * c_r * n[2] - v[2]
                cosine = mx * wx + my * wy + mz * wz
                cx, cy, cz = my * wz - mz * wy, mz * wx - mx * wz, mx * wy - my * wx
                sine = math.sqrt(cx * cx + cy * cy + cz * cz)
                apart = math.atan2(sine, cosine)
                angle = math.asin(math.sqrt(sine2))
                share, by_apart, by_angle, by_pixel = disc_share(apart, angle, footprints[row])
                if share > 0.0:
                    left, by_c = math.exp(-4.0 * roughness * c_r * c_r), 0.0
                    if index[0] > 0.0:
                        reflected, by_c = conductor_fresnel_slope(c_r, index[0], index[1])
                        by_c *= left
                        left *= reflected
                    value[i, s] += k_spike * left * share
                    by_material[i, s, D_K_SPIKE] = left * share
                    strength = k_spike * left
                    by_material[i, s, D_LN_SIGMA] += -8.0 * roughness * c_r * c_r * strength * share
                    fade = (k_spike * by_c - 8.0 * roughness * c_r * strength) * share
                    turn = -strength * by_apart / max(sine, 1e-12)
                    grow = strength * by_angle * math.tan(angle) / d
                    gx = turn * (mx - cosine * wx) / d - grow * wx
                    gy = turn * (my - cosine * wy) / d - grow * wy
                    gz = turn * (mz - cosine * wz) / d - grow * wz
                    _add(by_centre, i, s, gx, gy, gz)
                    _add(by_point, i, s, -gx, -gy, -gz)
                    on_v, on_w = fade + 2.0 * turn * c_i, 2.0 * turn * c_r
                    _add(by_normal, i, s, on_v * v[0] + on_w * wx, on_v * v[1] + on_w * wy, on_v * v[2] + on_w * wz)
                    _add(by_view, i, s, on_v * n[0] - turn * wx, on_v * n[1] - turn * wy, on_v * n[2] - turn * wz)
                    by_radius[i, s] += strength * by_angle / (d * math.cos(angle))
                    by_footprint[i, s] = strength * by_pixel

            if roughness <= 0.0:
                continue
            for q in range(len(nodes)):
                ax = nodes[q, 0] * frames[s, 0, 0] + nodes[q, 1] * frames[s, 1, 0]
                ay = nodes[q, 0] * frames[s, 0, 1] + nodes[q, 1] * frames[s, 1, 1]
                az = nodes[q, 0] * frames[s, 0, 2] + nodes[q, 1] * frames[s, 1, 2]
                light = _lobe_node(
                    i, s, masking, k_lobe, roughness, reach, rms_slope, index, n, v, c_r, qx + r * ax, qy + r * ay, qz + r * az,
                    nodes[q, 2], r, value, by_material, by_point, by_normal, by_view, towards,
                )  # fmt: skip
                if light == 0.0:
                    continue
                by_radius[i, s] += 2.0 * light / r + towards[0] * ax + towards[1] * ay + towards[2] * az
                for axis in range(3):
                    turned = 0.0
                    for other in range(3):
                        slope = nodes[q, 0] * frame_slopes[s, 0, other, axis] + nodes[q, 1] * frame_slopes[s, 1, other, axis]
                        turned += towards[other] * r * slope
                    by_centre[i, s, axis] += towards[axis] + turned
