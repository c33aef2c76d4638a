"""Stage: light that comes straight from the sources, equations (19)-(22) with the report's missing albedos put back.

The diffuse part uses the exact irradiance of a sphere, also where the horizon cuts it. `rays_per_source` 0 aims one shadow ray at
the middle of each source, and takes the lobe there; k > 0 spreads k over the source's solid angle: soft shadows.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.basis import frame_around
from rangecheck.kernels import inline_kernel, pasted_kernel, stage_kernel
from rangecheck.scene.sources import form_factor
from rangecheck.transport.chance import SHADOW, fill_disc, fill_points, key_of, point
from rangecheck.transport.queues import DIFFUSE
from rangecheck.transport.reflection import diffuse_of, lobe_of

_PER_PI = 1.0 / math.pi


@inline_kernel
def _put_shadow(shadows, k, hits, i, dx, dy, dz, far, source):
    """Shadow ray k from hit i."""
    for axis in range(3):
        shadows.origin[k, axis] = hits.place[i, axis]
    shadows.direction[k, 0], shadows.direction[k, 1], shadows.direction[k, 2] = dx, dy, dz
    shadows.far[k] = far
    shadows.pixel[k], shadows.first[k], shadows.source[k] = hits.pixel[i], hits.first[i], source


@pasted_kernel
def _put_gain(shadows, k, hits, i, materials, sources, source, dx, dy, dz, cosine, diffuse_light, lobe_light):
    """What shadow ray k brings: weight x (K_lm/pi x diffuse_light + K_sl f x lobe_light) x radiance; whether that is anything."""
    material = hits.material[i]
    nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
    vx, vy, vz = -float(hits.arriving[i, 0]), -float(hits.arriving[i, 1]), -float(hits.arriving[i, 2])
    total = diffuse = 0.0
    for c in range(shadows.gain.shape[1]):
        weight = hits.weight[i, c] * sources.radiance[source, c]
        part = weight * diffuse_of(materials, material, c) * diffuse_light * _PER_PI
        gain = part
        if lobe_light > 0.0:
            toward = vx * dx + vy * dy + vz * dz
            gain += weight * lobe_light * lobe_of(materials, material, c, cosine, vx * nx + vy * ny + vz * nz, toward)
        shadows.gain[k, c] = gain
        total += gain
        diffuse += part
    shadows.diffuse_share[k] = 1.0 if lobe_light <= 0.0 else (diffuse / total if total > 0.0 else 0.0)
    return total > 0.0


@stage_kernel
def aim(sources, materials, hits, start, stop, rays_per_source, with_diffuse, with_lobe, shadows):
    """Shadow rays from hits start..stop to all sources; returns how many. Source by source, so that neighbours stay neighbours."""
    k = np.int64(0)
    for s in range(len(sources.radius)):
        r2 = sources.radius[s] * sources.radius[s]
        if rays_per_source > 0:
            spread_over_source(hits, start, stop, s, rays_per_source, shadows)
        for i in range(start, stop):
            material = hits.material[i]
            nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
            x = sources.centre[s, 0] - hits.place[i, 0]
            y = sources.centre[s, 1] - hits.place[i, 1]
            z = sources.centre[s, 2] - hits.place[i, 2]
            d2 = x * x + y * y + z * z
            distance = math.sqrt(d2)
            nearness = 1.0 / distance
            x, y, z = x * nearness, y * nearness, z * nearness
            cosine = x * nx + y * ny + z * nz
            factor = form_factor(cosine, min(1.0, r2 / d2))
            if factor <= 0.0:
                continue
            diffuse_light = math.pi * factor if with_diffuse else 0.0
            shines = with_lobe and materials.shiny[material]
            if rays_per_source == 0:
                lobe_light = math.pi * factor if shines and cosine > 0.0 else 0.0
                if _put_gain(shadows, k, hits, i, materials, sources, s, x, y, z, cosine, diffuse_light, lobe_light):
                    _put_shadow(shadows, k, hits, i, x, y, z, distance - sources.radius[s], s)
                    k += 1
                continue
            k = aim_soft(
                sources, materials, hits, i, s, x, y, z, distance, rays_per_source, diffuse_light, shines, shadows,
                (i - start) * rays_per_source, k,
            )  # fmt: skip
    return k


@stage_kernel
def spread_over_source(hits, start, stop, s, rays, shadows):
    """Places on the disc that source s seems to be, `rays` for each of hits start..stop, one hit's after another's."""
    if rays == 1:
        fill_points(hits.stream, hits.number, SHADOW + s, start, stop - start, shadows.across, shadows.down)
    else:
        for i in range(start, stop):
            key = key_of(hits.stream[i], SHADOW + s)
            for j in range(rays):
                k = (i - start) * rays + j
                shadows.across[k], shadows.down[k] = point(key, hits.number[i] * rays + j)
    fill_disc((stop - start) * rays, shadows.across, shadows.down)


@pasted_kernel
def aim_soft(sources, materials, hits, i, s, x, y, z, distance, rays, diffuse_light, shines, shadows, place, k):
    """Rays to places of source s, from `place` on of those on its disc; it stands wholly above the horizon or is cut by it.

    Above: its directions' tangential parts fill an ellipse evenly (Nusselt 1928), so that every ray carries the same share of the exact
    irradiance, and only shadows make noise. Cut: rays spread evenly over its solid angle carry their cosines."""
    nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
    cosine = x * nx + y * ny + z * nz
    sine = min(1.0, sources.radius[s] / distance)
    sine2 = sine * sine
    whole = cosine > 0.0 and cosine * cosine > sine2
    depth = sine2 / (1.0 + math.sqrt(1.0 - sine2))
    ax, ay, az, bx, by, bz = frame_around(x, y, z)
    share = math.pi * sine2 * cosine / rays if whole else 2.0 * math.pi * depth / rays
    for j in range(rays):
        across, down = shadows.across[place + j], shadows.down[place + j]
        along, scale = 1.0 - depth, sine
        if not whole:
            # evenly over the solid angle: the height falls as the square of the disc's radius
            height = depth * (across * across + down * down)
            along, scale = 1.0 - height, math.sqrt(depth * (2.0 - height))
        e, f = scale * across, scale * down
        dx, dy, dz = along * x + e * ax + f * bx, along * y + e * ay + f * by, along * z + e * az + f * bz
        up = dx * nx + dy * ny + dz * nz
        if whole:
            # the disc's place keeps its tangential part and is lifted to the sphere of directions
            lift = math.sqrt(max(0.0, 1.0 - (dx * dx + dy * dy + dz * dz - up * up))) - up
            dx, dy, dz, up = dx + lift * nx, dy + lift * ny, dz + lift * nz, up + lift
        if up <= 0.0:
            continue
        light = share if whole else share * up
        straight = min(1.0, dx * x + dy * y + dz * z)
        reach = distance * (straight - math.sqrt(max(0.0, sine2 - (1.0 - straight * straight))))
        if _put_gain(
            shadows, k, hits, i, materials, sources, s, dx, dy, dz, up,
            light if diffuse_light > 0.0 else 0.0, light if shines else 0.0,
        ):  # fmt: skip
            _put_shadow(shadows, k, hits, i, dx, dy, dz, reach, s)
            k += 1
    return k


@stage_kernel
def add_light(shadows, n, reflections, sample, tally, part):
    """Add what no surface blocks to `sample` and to the tally, as light that was reflected so many times; what the
    surface seen did not reflect diffusely counts as `part`."""
    for k in range(n):
        if shadows.blocked[k]:
            continue
        pixel, source = shadows.pixel[k], shadows.source[k]
        light = 0.0
        for c in range(sample.shape[1]):
            sample[pixel, c] += shadows.gain[k, c]
            light += shadows.gain[k, c]
        if reflections == 1:
            diffuse = light * shadows.diffuse_share[k]
            tally[DIFFUSE, 1, source] += diffuse
            tally[part, 1, source] += light - diffuse
        else:
            tally[shadows.first[k], reflections, source] += light
