"""Scans of known objects at known poses, small enough that a test can afford many of them."""

import numpy as np

from rangecheck import rigid
from rangecheck.optics import PinholeCamera
from rangecheck.raycast import EmbreeCaster
from rangecheck.scan import RangeScan
from rangecheck.scan.simulate import RangeFinder, ring_of_poses, simulate_scan

CAMERA = PinholeCamera.from_field_of_view(150, 120, 22)


def pebble(seed: int, roughness: float = 0.09, ridges_mm: float = 0.0) -> EmbreeCaster:
    """A closed, star-shaped object of about 80 mm radius whose bumps repeat nowhere, with ridges of this height and some 5 mm apart."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5 if ridges_mm == 0 else 7)
    directions = np.asarray(ball.vertices)
    rng = np.random.default_rng(seed)
    radius = np.full(len(directions), 80.0)
    for wavelength, share in ((1.5, 1.0), (3.0, 0.6), (6.0, 0.25)):
        for _ in range(4):
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
            radius += 80 * roughness * share * np.sin(wavelength * directions @ axis * 2 + rng.uniform(0, 2 * np.pi))
    # sharp above and round below, as hair is modelled: their two sides are not alike
    radius += ridges_mm * (1.0 - np.abs(np.sin(16 * directions[:, 0] + 8 * directions[:, 1] + 2 * np.sin(5 * directions[:, 2]))))
    return EmbreeCaster(directions * radius[:, None], np.asarray(ball.faces))


def plate(bump_mm: float = 0.0) -> EmbreeCaster:
    """A flat plate in the plane z = 0, 400 mm wide."""
    side = np.linspace(-200, 200, 41)
    x, y = np.meshgrid(side, side)
    z = bump_mm * np.sin(x / 20) * np.cos(y / 27)
    index = np.arange(41 * 41).reshape(41, 41)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([b, d, c], -1).reshape(-1, 3)])
    return EmbreeCaster(np.stack([x, y, z], -1).reshape(-1, 3), faces)


def ring(
    caster, count: int = 8, noise_mm: float = 0.1, name: str = "view", elevations_deg=(0.0,), camera=CAMERA
) -> list[RangeScan]:
    """`count` scans around the y axis at their true poses."""
    finder = RangeFinder(source_mm=(100.0, 0.0, 0.0), working_distance_mm=600.0, noise_mm=noise_mm)
    poses = ring_of_poses(count, 600.0, elevations_deg=elevations_deg)
    return [simulate_scan(caster, camera, p, finder, 7, scan_index=k, name=f"{name}{k}").scan for k, p in enumerate(poses)]


def shaken(scans: list[RangeScan], mm: float, deg: float, seed: int = 0) -> list[RangeScan]:
    """All scans but the first, shifted by `mm` and turned by `deg` about their middles in directions drawn from `seed`."""
    rng = np.random.default_rng(seed)
    result = scans[:1]
    for scan in scans[1:]:
        middle = scan.points_mm().mean(axis=0)
        shift = rng.normal(size=3)
        turn = rigid.about_axis(rng.normal(size=3), np.radians(deg))
        turn[:3, 3] = middle + mm * shift / np.linalg.norm(shift) - turn[:3, :3] @ middle
        result.append(scan.moved(turn @ scan.world_from_scan))
    return result


def strays_mm(scans: list[RangeScan], truth: list[RangeScan]) -> np.ndarray:
    """For each scan the median distance of its points from where the truth puts them, after the first is laid on its truth."""
    back = truth[0].world_from_scan @ rigid.inverse(scans[0].world_from_scan)
    return np.array(
        [
            np.median(np.linalg.norm(rigid.move_points(back, s.points_mm()) - t.points_mm(), axis=1))
            for s, t in zip(scans, truth, strict=True)
        ]
    )
