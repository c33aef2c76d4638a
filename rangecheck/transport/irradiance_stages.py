"""Stages of keeping irradiance: places look out, remember what they meet, and add up what it sends them (see `irradiance`)."""

from __future__ import annotations

import math

import numpy as np

from rangecheck.basis import frame_around
from rangecheck.kernels import inline_kernel, stage_kernel
from rangecheck.scene.surroundings import add_surroundings
from rangecheck.transport.chance import DIFFUSE_WAY, key_of, point, stream_of, turned
from rangecheck.transport.irradiance_nodes import nodes_around
from rangecheck.transport.queues import CAMERA


@stage_kernel
def mix(near, weight, light, result):
    """Light at nodes, from that at the records near them."""
    for i in range(len(near)):
        for c in range(light.shape[1]):
            total = 0.0
            for k in range(near.shape[1]):
                total += weight[i, k] * light[near[i, k], c]
            result[i, c] = total


@stage_kernel
def stand(place, normal, skin, seed, first, hits):
    """Nodes as hits that somebody sees who looks along their normals."""
    for i in range(len(place)):
        for axis in range(3):
            hits.place[i, axis] = place[i, axis] + skin * normal[i, axis]
            hits.shading[i, axis] = hits.facing[i, axis] = normal[i, axis]
            hits.arriving[i, axis] = -normal[i, axis]
        for c in range(hits.weight.shape[1]):
            hits.weight[i, c] = 1.0
        hits.pixel[i], hits.first[i], hits.material[i] = i, CAMERA, 0
        hits.stream[i], hits.number[i] = stream_of(seed, first + i), 0


@stage_kernel
def look_out(place, normal, skin, count, seed, first, rays):
    """`count` rays from each place, spread evenly by their cosine; each carries its share of the hemisphere's light."""
    k = np.int64(0)
    for i in range(len(place)):
        nx, ny, nz = float(normal[i, 0]), float(normal[i, 1]), float(normal[i, 2])
        ax, ay, az, bx, by, bz = frame_around(nx, ny, nz)
        key = key_of(stream_of(seed, first + i), DIFFUSE_WAY)
        for j in range(count):
            p, q = point(key, j)
            aside, up = math.sqrt(p), math.sqrt(1.0 - p)
            cos_turn, sin_turn = turned(q)
            e, f = aside * cos_turn, aside * sin_turn
            rays.direction[k, 0] = e * ax + f * bx + up * nx
            rays.direction[k, 1] = e * ay + f * by + up * ny
            rays.direction[k, 2] = e * az + f * bz + up * nz
            for axis in range(3):
                rays.origin[k, axis] = place[i, axis] + skin * normal[i, axis]
            rays.far[k] = math.inf
            for c in range(rays.weight.shape[1]):
                rays.weight[k, c] = 1.0 / count
            k += 1


@inline_kernel
def seen_from_behind(vertices, faces, normals, rows, face, dx, dy, dz):
    """Whether a ray meets the side of a face that its corners' normals turn away from."""
    a, b, c, row = faces[face, 0], faces[face, 1], faces[face, 2], rows[face, 0]
    ex, ey, ez = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
    fx, fy, fz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    out = gx * normals[row, 0] + gy * normals[row, 1] + gz * normals[row, 2]
    return (gx * dx + gy * dy + gz * dz > 0.0) == (out > 0.0)


@stage_kernel
def see_sky(surroundings, geometry, rays, count, met, light):
    """Add what rays see of the surroundings to their records; mark back sides."""
    sky, frame, period, softness, low, high, picture, boxes, glow = surroundings
    vertices, faces, normals, rows, _, _ = geometry
    for k in range(len(met)):
        face = np.int64(met[k])
        dx, dy, dz = float(rays.direction[k, 0]), float(rays.direction[k, 1]), float(rays.direction[k, 2])
        if face < 0:
            add_surroundings(
                sky, frame, period, softness, low, high, picture, boxes, glow, dx, dy, dz, rays.weight, k, light, k // count
            )  # fmt: skip
        elif seen_from_behind(vertices, faces, normals, rows, face, dx, dy, dz):
            met[k] = -2 - face


@stage_kernel
def sum_up(node_of_face, steps, light, albedo, materials, nodes, count, faces, us, vs, sky, seen):
    """Light that records see: of the surroundings, and of the places that their rays met.

    The back side of a closed surface is met only by rays that start below the faces of a rounded edge; they are left out."""
    back = nodes if len(light) > nodes else np.int64(0)
    k = np.int64(0)
    for i in range(len(seen)):
        left_out = 0
        for c in range(seen.shape[1]):
            seen[i, c] = 0.0
        for _ in range(count):
            face, shift = np.int64(faces[k]), np.int64(0)
            if face < -1:
                face, shift = -2 - face, back
                if back == 0:
                    left_out += 1
                    face = np.int64(-1)
            if face >= 0:
                a, b, d, p, q, r = nodes_around(node_of_face, steps, face, float(us[k]), float(vs[k]))
                for c in range(seen.shape[1]):
                    white = p * light[a + shift, c] + q * light[b + shift, c] + r * light[d + shift, c]
                    seen[i, c] += albedo[materials[face], c] * white
            k += 1
        for c in range(seen.shape[1]):
            seen[i, c] = (sky[i, c] * count + seen[i, c]) / max(count - left_out, 1)


@stage_kernel
def look_up(stored, direct, face, u, v, back, kept, straight):
    """Stored and direct light at places of faces."""
    nodes = len(stored.light) // stored.sides
    for i in range(len(face)):
        shift = nodes if back[i] else np.int64(0)
        a, b, d, p, q, r = nodes_around(stored.node_of_face, stored.steps, face[i], u[i], v[i])
        for c in range(kept.shape[1]):
            kept[i, c] = p * stored.light[a + shift, c] + q * stored.light[b + shift, c] + r * stored.light[d + shift, c]
            straight[i, c] = p * direct[a + shift, c] + q * direct[b + shift, c] + r * direct[d + shift, c]
