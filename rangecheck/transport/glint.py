"""Stage: sources that the spike mirrors into the pixel, figures 6 and 7.

One mirror ray through the middle of a pixel misses a source that is smaller than the pixel. The report adds the rays through the
pixel's four corners and, when the source lies among their mirror directions, takes it as seen in the middle: `corners`. That lights the
whole pixel, so that a highlight's energy grows with the pixel. `fraction` takes the share of the pixel's mirrored footprint that the source
fills: the area of the circle inside the polygon of mirrored corners, of the pixel's sixteenths where it matters.

Mirror rays are followed to the plane through the source's middle that faces the surface; lengths there are divided by its distance,
so that the source is a circle of radius tan(alpha) about the origin.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.basis import frame_around
from rangecheck.kernels import stage_kernel
from rangecheck.transport.geometry import place_hit
from rangecheck.transport.reflection import spike_of
from rangecheck.transport.scatter import mirror_ray

#: a pixel whose middle mirrors further than this from a source's rim is taken not to see it: radians
REACH = 0.25
#: cells along a side of a pixel whose footprint meets a source
CELLS = 4
#: corners whose mirror directions lie further apart than this (tangent) do not belong to one smooth footprint
_TORN = 1.0


@stage_kernel
def find_glints(materials, sources, hits, n, glint_hit, glint_source):
    """Which of n hits may mirror which source: pairs (hit, source); returns how many."""
    k = np.int64(0)
    room = len(glint_hit)
    for i in range(n):
        if not materials.shiny[hits.material[i]]:
            continue
        x, y, z = mirror_ray(hits, i)
        for s in range(len(sources.radius)):
            ax, ay, az = (
                sources.centre[s, 0] - hits.place[i, 0],
                sources.centre[s, 1] - hits.place[i, 1],
                sources.centre[s, 2] - hits.place[i, 2],
            )
            distance = math.sqrt(ax * ax + ay * ay + az * az)
            cosine = (ax * x + ay * y + az * z) / distance
            alpha = math.asin(min(1.0, sources.radius[s] / distance))
            if cosine > math.cos(min(math.pi, alpha + REACH)) and k < room:
                glint_hit[k], glint_source[k] = i, s
                k += 1
    return k


@stage_kernel
def corner_places(glint_pixel, n, width, cells, places):
    """Pixel coordinates of the (cells + 1)^2 corners of every pixel's cells."""
    k = np.int64(0)
    for i in range(n):
        row = glint_pixel[i] // width
        for r in range(cells + 1):
            for c in range(cells + 1):
                places[0, k] = glint_pixel[i] - row * width + c / cells - 0.5
                places[1, k] = row + r / cells - 0.5
                k += 1


@stage_kernel
def mirrored_corners(geometry, rays, n, hits, places, directions):
    """Places and mirror directions (n, 3) of cast corner rays; NaN where they met nothing. `hits` is scratch of at least one row."""
    vertices, faces, normals, rows, _, skin = geometry
    for i in range(n):
        if rays.face[i] < 0:
            directions[i, 0] = directions[i, 1] = directions[i, 2] = math.nan
            continue
        dx, dy, dz = float(rays.direction[i, 0]), float(rays.direction[i, 1]), float(rays.direction[i, 2])
        place_hit(
            vertices, faces, normals, rows, skin, rays.face[i], float(rays.u[i]), float(rays.v[i]), dx, dy, dz,
            hits.place, hits.shading, hits.facing, 0,
        )  # fmt: skip
        for axis in range(3):
            hits.arriving[0, axis] = rays.direction[i, axis]
        directions[i, 0], directions[i, 1], directions[i, 2] = mirror_ray(hits, 0)
        for axis in range(3):
            places[i, axis] = hits.place[0, axis]


@stage_kernel
def _angle(px, py, qx, qy):
    return math.atan2(px * qy - py * qx, px * qx + py * qy)


@stage_kernel
def circle_in_wedge(px, py, qx, qy, radius):
    """Signed area that a circle about the origin shares with the triangle (0, p, q)."""
    r2 = radius * radius
    dx, dy = qx - px, qy - py
    a = dx * dx + dy * dy
    b = px * dx + py * dy
    root = b * b - a * (px * px + py * py - r2)
    if not (a > 0.0 and root > 0.0):
        return 0.5 * r2 * _angle(px, py, qx, qy)
    root = math.sqrt(root)
    start, end = (-b - root) / a, (-b + root) / a
    if start >= 1.0 or end <= 0.0:
        return 0.5 * r2 * _angle(px, py, qx, qy)
    area = 0.0
    ax, ay, bx, by = px, py, qx, qy
    if start > 0.0:
        ax, ay = px + start * dx, py + start * dy
        area += 0.5 * r2 * _angle(px, py, ax, ay)
    if end < 1.0:
        bx, by = px + end * dx, py + end * dy
        area += 0.5 * r2 * _angle(bx, by, qx, qy)
    return area + 0.5 * (ax * by - ay * bx)


@stage_kernel
def _seen_share(corners, radius):
    """Share of the quadrilateral corners (4, 2) that the circle fills; -1 where it is torn."""
    total = shared = 0.0
    for k in range(4):
        m = (k + 1) % 4
        px, py, qx, qy = corners[k, 0], corners[k, 1], corners[m, 0], corners[m, 1]
        if not math.hypot(qx - px, qy - py) < _TORN:
            return -1.0
        total += 0.5 * (px * qy - py * qx)
        shared += circle_in_wedge(px, py, qx, qy, radius)
    if total == 0.0:
        return -1.0
    return max(0.0, min(1.0, shared / total))


@stage_kernel
def _seen_from(sources, s, hits, hit):
    """(direction, distance) of source s from a hit, and the radius that it has in the plane through its middle."""
    x = sources.centre[s, 0] - hits.place[hit, 0]
    y = sources.centre[s, 1] - hits.place[hit, 1]
    z = sources.centre[s, 2] - hits.place[hit, 2]
    distance = math.sqrt(x * x + y * y + z * z)
    sine = min(0.999, sources.radius[s] / distance)
    return x / distance, y / distance, z / distance, distance, sine / math.sqrt(1.0 - sine * sine)


@stage_kernel
def _footprint(sources, s, x, y, z, distance, places, directions, first, row, quad):
    """Where the mirror rays of one cell's corners (first, first + 1, first + row + 1, first + row) meet the plane through the source;
    False where one of them does not."""
    ax, ay, az, bx, by, bz = frame_around(x, y, z)
    for k in range(4):
        j = first + (row if k >= 2 else 0) + (1 if k == 1 or k == 2 else 0)
        dx, dy, dz = directions[j, 0], directions[j, 1], directions[j, 2]
        ahead = dx * x + dy * y + dz * z
        if not ahead > 0.1:
            return False
        px = (places[j, 0] - sources.centre[s, 0]) / distance
        py = (places[j, 1] - sources.centre[s, 1]) / distance
        pz = (places[j, 2] - sources.centre[s, 2]) / distance
        far = -(px * x + py * y + pz * z) / ahead
        px, py, pz = px + far * dx, py + far * dy, pz + far * dz
        quad[k, 0] = px * ax + py * ay + pz * az
        quad[k, 1] = px * bx + py * by + pz * bz
    return True


@stage_kernel
def keep_near(sources, hits, glint_hit, glint_source, n, places, directions, quad):
    """Keep, in place and in order, the pairs whose whole pixel's footprint lies no further from the source than its own size, and
    those that have none; returns how many."""
    k = np.int64(0)
    for i in range(n):
        hit, s = glint_hit[i], glint_source[i]
        x, y, z, distance, radius = _seen_from(sources, s, hits, hit)
        near = True
        if _footprint(sources, s, x, y, z, distance, places, directions, 4 * i, 2, quad):
            size = aside = 0.0
            for c in range(4):
                size = max(size, math.hypot(quad[c, 0] - quad[(c + 2) % 4, 0], quad[c, 1] - quad[(c + 2) % 4, 1]))
                size = max(size, math.hypot(quad[c, 0] - quad[(c + 1) % 4, 0], quad[c, 1] - quad[(c + 1) % 4, 1]))
            aside = math.hypot(quad[0, 0] + quad[2, 0], quad[0, 1] + quad[2, 1]) / 2
            near = aside < radius + 2.0 * size
        if near:
            glint_hit[k], glint_source[k] = hit, s
            k += 1
    return k


@stage_kernel
def glint_shares(sources, hits, glint_hit, glint_source, n, cells, places, directions, whole, quad, share):
    """share (n,) of each pixel in which the source is mirrored; `whole`: all of it as soon as any, as the report has it.

    places, directions (n (cells + 1)^2, 3); quad (4, 2) is scratch. A cell without a smooth footprint (its corners meet different things) is
    judged by the hit's own mirror ray."""
    row = cells + 1
    for i in range(n):
        hit, s = glint_hit[i], glint_source[i]
        x, y, z, distance, radius = _seen_from(sources, s, hits, hit)
        mx, my, mz = mirror_ray(hits, hit)
        middle = mx * x + my * y + mz * z
        inside = 1.0 if middle > 0.0 and middle * middle * (1.0 + radius * radius) >= 1.0 else 0.0
        total = 0.0
        for r in range(cells):
            for c in range(cells):
                first = i * row * row + r * row + c
                smooth = _footprint(sources, s, x, y, z, distance, places, directions, first, row, quad)
                seen = _seen_share(quad, radius) if smooth else -1.0
                total += inside if seen < 0.0 else seen
        share[i] = total / (cells * cells)
        if whole:
            share[i] = 1.0 if share[i] > 1e-6 else 0.0


@stage_kernel
def aim_glints(sources, materials, hits, glint_hit, glint_source, share, n, shadows):
    """Shadow rays to the sources that are mirrored, with what they bring; returns how many."""
    k = np.int64(0)
    for i in range(n):
        # what is left of rounding is no highlight
        if not share[i] > 1e-9:
            continue
        hit, s = glint_hit[i], glint_source[i]
        x, y, z = (
            sources.centre[s, 0] - hits.place[hit, 0],
            sources.centre[s, 1] - hits.place[hit, 1],
            sources.centre[s, 2] - hits.place[hit, 2],
        )
        distance = math.sqrt(x * x + y * y + z * z)
        cosine = -float(
            hits.arriving[hit, 0] * hits.shading[hit, 0]
            + hits.arriving[hit, 1] * hits.shading[hit, 1]
            + hits.arriving[hit, 2] * hits.shading[hit, 2]
        )
        for c in range(shadows.gain.shape[1]):
            shadows.gain[k, c] = (
                share[i] * hits.weight[hit, c] * sources.radiance[s, c] * spike_of(materials, hits.material[hit], c, cosine)
            )
        for axis in range(3):
            shadows.origin[k, axis] = hits.place[hit, axis]
        shadows.direction[k, 0], shadows.direction[k, 1], shadows.direction[k, 2] = x / distance, y / distance, z / distance
        shadows.far[k] = distance - sources.radius[s]
        shadows.diffuse_share[k] = 0.0
        shadows.pixel[k], shadows.first[k], shadows.source[k] = hits.pixel[hit], hits.first[hit], s
        k += 1
    return k
