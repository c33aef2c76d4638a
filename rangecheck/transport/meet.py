"""Stage: rays that have been cast meet a source, a surface, or the surroundings; equations (23)-(31), one recursion step each.

Light is tallied as it arrives: tally[first reflection, number of reflections, light], light 0 .. s-1 the sources, s the
surroundings; sums over pixels and wavelengths, divided at the end.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.kernels import inline_kernel, stage_kernel
from rangecheck.scene.surroundings import CONSTANT, add_surroundings
from rangecheck.transport.geometry import place_hit
from rangecheck.transport.irradiance_nodes import nodes_around
from rangecheck.transport.queues import CAMERA, DIFFUSE, SPIKE


@inline_kernel
def source_ahead(centre, radius, ox, oy, oz, dx, dy, dz, far):
    """Index of the nearest source nearer than `far` on the ray, or -1."""
    found, nearest = np.int64(-1), far
    for s in range(len(radius)):
        x, y, z = centre[s, 0] - ox, centre[s, 1] - oy, centre[s, 2] - oz
        along = x * dx + y * dy + z * dz
        if along > 0.0:
            # the distance of the centre from the ray, squared: from the cross product, which keeps its digits far away
            cx, cy, cz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
            rest = radius[s] * radius[s] - cx * cx - cy * cy - cz * cz
            if rest > 0.0:
                distance = along - math.sqrt(rest)
                if 0.0 < distance < nearest:
                    found, nearest = np.int64(s), distance
    return found


@stage_kernel
def meet(geometry, sources, surroundings, stored, rays, n, reflections, backdrop, gather_sources, hits, sample, tally):
    """Sort n cast rays: light that they see is added to `sample`, surfaces that they hit are written to `hits`.

    backdrop: the camera itself sees surroundings. gather_sources: rays that mirror see sources (else another way accounts for
    them); rays that gather over a lobe or a hemisphere never do, for sources light surfaces directly. stored: light of their hemispheres that
    is kept on the surfaces (see `irradiance`). Returns the number of hits."""
    # taken apart once, not ray by ray
    vertices, corners, normals, rows, materials, skin = geometry
    centre, radius, radiance = sources
    sky, frame, period, softness, low, high, picture, boxes, glow = surroundings
    origin, direction, far, faces, us, vs, weight, pixels, kinds, firsts, streams, numbers = rays
    place, shading, facing, arriving, hit_weight, hit_pixel, hit_first, hit_material, hit_stream, hit_number, settled = hits
    node_of_face, steps, kept, albedo, sides, shares = stored
    count = np.int64(0)
    dark = True
    for c in range(sample.shape[1]):
        dark = dark and sky == CONSTANT and low[c] == 0.0 and len(boxes) == 0
    channels = sample.shape[1]
    for i in range(n):
        face, kind, pixel = faces[i], kinds[i], pixels[i]
        dx, dy, dz = float(direction[i, 0]), float(direction[i, 1]), float(direction[i, 2])
        if len(radius) > 0 and (kind == CAMERA or (kind == SPIKE and gather_sources)):
            reach = float(far[i]) if face >= 0 else math.inf
            ox, oy, oz = float(origin[i, 0]), float(origin[i, 1]), float(origin[i, 2])
            seen = source_ahead(centre, radius, ox, oy, oz, dx, dy, dz, reach)
            if seen >= 0:
                for c in range(channels):
                    light = weight[i, c] * radiance[seen, c]
                    sample[pixel, c] += light
                    tally[firsts[i], reflections, seen] += light
                continue
        if face < 0:
            if not dark and (kind != CAMERA or backdrop):
                tally[firsts[i], reflections, len(radius)] += add_surroundings(
                    sky, frame, period, softness, low, high, picture, boxes, glow, dx, dy, dz, weight, i, sample, pixel
                )
            continue
        place_hit(
            vertices, corners, normals, rows, skin, face, float(us[i]), float(vs[i]), dx, dy, dz, place, shading, facing, count
        )  # fmt: skip
        for axis in range(3):
            arriving[count, axis] = direction[i, axis]
        for c in range(channels):
            hit_weight[count, c] = weight[i, c]
        hit_pixel[count], hit_first[count], hit_stream[count] = pixel, firsts[i], streams[i]
        hit_material[count], hit_number[count] = materials[face], numbers[i]
        settled[count] = False
        if sides > 0 and reflections + 1 < tally.shape[1]:
            out = 0.0
            for axis in range(3):
                out += facing[count, axis] * normals[rows[face, 0], axis]
            if sides == 2 or out > 0.0:
                settled[count] = True
                shift = np.int64(0) if out > 0.0 else np.int64(len(kept) // 2)
                a, b, d, p, q, r = nodes_around(node_of_face, steps, face, float(us[i]), float(vs[i]))
                total = 0.0
                for c in range(channels):
                    white = p * kept[a + shift, c] + q * kept[b + shift, c] + r * kept[d + shift, c]
                    light = weight[i, c] * albedo[materials[face], c] * white
                    sample[pixel, c] += light
                    total += light
                first = DIFFUSE if kind == CAMERA else firsts[i]
                for s in range(len(shares)):
                    tally[first, reflections + 1, s] += total * shares[s]
        count += 1
    return count
