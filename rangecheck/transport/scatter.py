"""Stage: surfaces send on the light they wait for; equations (24), (32)-(43).

Each hit asks for light along the mirror direction (spike), over the lobe's effective area, and over the hemisphere (diffuse, which the
report sets to 0 in (44)). `split` sends rays for each of the three; `choose_one` sends one ray for all, with weights that
keep the mean. Rays leave above the face and above the shading normal's horizon, or not at all.
"""

from __future__ import annotations

import math

import numpy as np

from rangecheck.basis import frame_around
from rangecheck.kernels import pasted_kernel, stage_kernel
from rangecheck.transport.chance import BRANCH, CHOICE, DIFFUSE_WAY, key_of, point, turned
from rangecheck.transport.queues import CAMERA, DIFFUSE, LOBE, SPIKE
from rangecheck.transport.reflection import diffuse_of, draw_lobe, lobe_guess, lobe_of, spike_of


@stage_kernel
def mirror_ray(hits, i):
    """Direction in which hit i mirrors, kept just above its face."""
    nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
    dx, dy, dz = float(hits.arriving[i, 0]), float(hits.arriving[i, 1]), float(hits.arriving[i, 2])
    twice = -2.0 * (dx * nx + dy * ny + dz * nz)
    x, y, z = dx + twice * nx, dy + twice * ny, dz + twice * nz
    fx, fy, fz = float(hits.facing[i, 0]), float(hits.facing[i, 1]), float(hits.facing[i, 2])
    above = x * fx + y * fy + z * fz
    if above < 1e-4:
        x, y, z = x + (1e-4 - above) * fx, y + (1e-4 - above) * fy, z + (1e-4 - above) * fz
    size = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * size, y * size, z * size


@pasted_kernel
def _send(rays, k, hits, i, dx, dy, dz, kind, number):
    """Ray k leaves hit i; its weight is already written."""
    for axis in range(3):
        rays.origin[k, axis] = hits.place[i, axis]
    rays.direction[k, 0], rays.direction[k, 1], rays.direction[k, 2] = dx, dy, dz
    rays.far[k] = math.inf
    rays.pixel[k], rays.kind[k] = hits.pixel[i], kind
    rays.first[k] = kind if hits.first[i] == CAMERA else hits.first[i]
    rays.stream[k], rays.number[k] = key_of(hits.stream[i], BRANCH + kind), number


@pasted_kernel
def _clear_of_face(hits, i, dx, dy, dz):
    return dx * hits.facing[i, 0] + dy * hits.facing[i, 1] + dz * hits.facing[i, 2] > 0.0


@pasted_kernel
def _send_spike(materials, hits, i, share, least, rays, k):
    """The mirror ray, equation (34), unless it carries no more than `least`; returns the number of rays sent."""
    cosine = -(
        hits.arriving[i, 0] * hits.shading[i, 0]
        + hits.arriving[i, 1] * hits.shading[i, 1]
        + hits.arriving[i, 2] * hits.shading[i, 2]
    )
    most = 0.0
    for c in range(rays.weight.shape[1]):
        weight = hits.weight[i, c] * spike_of(materials, hits.material[i], c, float(cosine)) / share
        rays.weight[k, c] = weight
        most = max(most, weight)
    if most <= least:
        return 0
    x, y, z = mirror_ray(hits, i)
    _send(rays, k, hits, i, x, y, z, SPIKE, hits.number[i])
    return 1


@pasted_kernel
def _send_lobe(materials, hits, i, share, least, number, rays, k):
    """One ray drawn by scattering order; `share` of such rays make the estimate."""
    material = hits.material[i]
    nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
    vx, vy, vz = -float(hits.arriving[i, 0]), -float(hits.arriving[i, 1]), -float(hits.arriving[i, 2])
    cosine = vx * nx + vy * ny + vz * nz
    p, q, r, density = draw_lobe(materials, material, cosine, key_of(hits.stream[i], BRANCH + LOBE), number)
    if r <= 0.0:
        return 0
    # the frame's x axis is the viewer's tangential part; where there is none, any will do
    ax, ay, az = vx - cosine * nx, vy - cosine * ny, vz - cosine * nz
    sine = math.sqrt(ax * ax + ay * ay + az * az)
    if sine > 1e-6:
        ax, ay, az = ax / sine, ay / sine, az / sine
    else:
        ax, ay, az, _, _, _ = frame_around(nx, ny, nz)
    bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    dx, dy, dz = p * ax + q * bx + r * nx, p * ay + q * by + r * ny, p * az + q * bz + r * nz
    if not (density > 0.0 and _clear_of_face(hits, i, dx, dy, dz)):
        return 0
    toward = vx * dx + vy * dy + vz * dz
    most = 0.0
    for c in range(rays.weight.shape[1]):
        weight = hits.weight[i, c] * lobe_of(materials, material, c, r, cosine, toward) * r / (density * share)
        rays.weight[k, c] = weight
        most = max(most, weight)
    if not most > least:
        return 0
    _send(rays, k, hits, i, dx, dy, dz, LOBE, number)
    return 1


@pasted_kernel
def _send_diffuse(materials, hits, i, share, least, number, rays, k):
    """One ray of the hemisphere, drawn by its cosine."""
    material = hits.material[i]
    most = 0.0
    for c in range(rays.weight.shape[1]):
        weight = hits.weight[i, c] * diffuse_of(materials, material, c) / share
        rays.weight[k, c] = weight
        most = max(most, weight)
    if most <= least:
        return 0
    nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
    ax, ay, az, bx, by, bz = frame_around(nx, ny, nz)
    p, q = point(key_of(key_of(hits.stream[i], BRANCH + DIFFUSE), DIFFUSE_WAY), number)
    radius = math.sqrt(p)
    cos_turn, sin_turn = turned(q)
    e, f, up = radius * cos_turn, radius * sin_turn, math.sqrt(1.0 - p)
    dx, dy, dz = e * ax + f * bx + up * nx, e * ay + f * by + up * ny, e * az + f * bz + up * nz
    if not _clear_of_face(hits, i, dx, dy, dz):
        return 0
    _send(rays, k, hits, i, dx, dy, dz, DIFFUSE, number)
    return 1


@stage_kernel
def _send_fan(materials, hits, i, rings, step, least, rays, k):
    """Rings `step` apart around the mirror direction, 6 m rays in ring m, each weighted by its own solid angle (39); those below the
    surface are dropped. Equation (38)."""
    material = hits.material[i]
    nx, ny, nz = float(hits.shading[i, 0]), float(hits.shading[i, 1]), float(hits.shading[i, 2])
    vx, vy, vz = -float(hits.arriving[i, 0]), -float(hits.arriving[i, 1]), -float(hits.arriving[i, 2])
    cosine = vx * nx + vy * ny + vz * nz
    rx, ry, rz = mirror_ray(hits, i)
    ax, ay, az, bx, by, bz = frame_around(rx, ry, rz)
    sent = np.int64(0)
    for ring in range(rings + 1):
        count = max(1, 6 * ring)
        inner = math.cos((ring - 0.5) * step) if ring > 0 else 1.0
        solid_angle = 2.0 * math.pi * (inner - math.cos((ring + 0.5) * step)) / count
        e, up = math.sin(ring * step), math.cos(ring * step)
        for j in range(count):
            turn = 2.0 * math.pi * j / count
            p, q = e * math.cos(turn), e * math.sin(turn)
            dx, dy, dz = p * ax + q * bx + up * rx, p * ay + q * by + up * ry, p * az + q * bz + up * rz
            high = dx * nx + dy * ny + dz * nz
            if high <= 0.0 or not _clear_of_face(hits, i, dx, dy, dz):
                continue
            toward = vx * dx + vy * dy + vz * dz
            most = 0.0
            at = k + sent
            for c in range(rays.weight.shape[1]):
                weight = hits.weight[i, c] * lobe_of(materials, material, c, high, cosine, toward) * high * solid_angle
                rays.weight[at, c] = weight
                most = max(most, weight)
            if most > least:
                _send(rays, at, hits, i, dx, dy, dz, LOBE, np.uint32(hits.number[i] + j))
                sent += 1
    return sent


@stage_kernel
def split(materials, hits, start, stop, with_spike, lobe_rays, fan_step, diffuse_rays, least, rays):
    """Rays for all three parts of hits start..stop; returns how many. Those that carry no more than `least` stay. With fan_step > 0
    the lobe is gathered by `lobe_rays` rings that many radians apart, else by so many rays drawn by scattering order."""
    k = np.int64(0)
    for i in range(start, stop):
        if materials.shiny[hits.material[i]]:
            if with_spike:
                k += _send_spike(materials, hits, i, 1.0, least, rays, k)
            if fan_step > 0.0:
                k += _send_fan(materials, hits, i, lobe_rays, fan_step, least, rays, k)
            for j in range(0 if fan_step > 0.0 else lobe_rays):
                k += _send_lobe(materials, hits, i, float(lobe_rays), least, hits.number[i] * lobe_rays + j, rays, k)
        for j in range(0 if hits.settled[i] else diffuse_rays):
            k += _send_diffuse(materials, hits, i, float(diffuse_rays), least, hits.number[i] * diffuse_rays + j, rays, k)
    return k


@stage_kernel
def choose_one(materials, hits, start, stop, with_spike, with_lobe, with_diffuse, roulette, least, rays):
    """At most one ray for each of hits start..stop, its part chosen by how much it reflects; returns how many.

    With `roulette` a path goes on with the probability of what it carries, and then carries that much more: the mean stays."""
    k = np.int64(0)
    for i in range(start, stop):
        material = hits.material[i]
        cosine = -float(
            hits.arriving[i, 0] * hits.shading[i, 0]
            + hits.arriving[i, 1] * hits.shading[i, 1]
            + hits.arriving[i, 2] * hits.shading[i, 2]
        )
        spike = lobe = diffuse = 0.0
        for c in range(rays.weight.shape[1]):
            carried = hits.weight[i, c]
            if materials.shiny[material]:
                if with_spike:
                    spike = max(spike, carried * spike_of(materials, material, c, cosine))
                if with_lobe:
                    lobe = max(lobe, carried * lobe_guess(materials, material, c, cosine))
            if with_diffuse and not hits.settled[i]:
                diffuse = max(diffuse, carried * diffuse_of(materials, material, c))
        total = spike + lobe + diffuse
        if total <= least:
            continue
        choice, luck = point(key_of(hits.stream[i], CHOICE), hits.number[i])
        goes_on = min(1.0, total) if roulette else 1.0
        if luck >= goes_on:
            continue
        choice *= total
        if choice < spike:
            k += _send_spike(materials, hits, i, goes_on * spike / total, 0.0, rays, k)
        elif choice < spike + lobe:
            k += _send_lobe(materials, hits, i, goes_on * lobe / total, 0.0, hits.number[i], rays, k)
        elif diffuse > 0.0:
            k += _send_diffuse(materials, hits, i, goes_on * diffuse / total, 0.0, hits.number[i], rays, k)
    return k
