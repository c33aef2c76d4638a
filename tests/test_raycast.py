"""Rays against triangles: the fast engine finds what the slow one finds, whichever way it is called."""

import numpy as np
import pytest

from rangecheck.errors import SurfaceError
from rangecheck.raycast import BruteCaster, EmbreeCaster, direct


def bumpy_sheet(n=24, seed=1):
    """A rough square sheet of 2 n^2 faces over [0, 100]^2 mm."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 100, n + 1), np.linspace(0, 100, n + 1))
    vertices = np.stack([x, y, rng.normal(scale=4.0, size=x.shape)], axis=-1).reshape(-1, 3)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return vertices, np.concatenate(
        [np.stack([corner, corner + 1, corner + n + 2], 1), np.stack([corner, corner + n + 2, corner + n + 1], 1)]
    ).astype(np.int32)


def rays_at(vertices, n, seed, away_mm=150.0):
    rng = np.random.default_rng(seed)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origins = 0.5 * (low + high) + away_mm * rng.normal(size=(n, 3))
    directions = rng.uniform(low - 10, high + 10, (n, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(params=["direct", "compact", "embreex"])
def engine(request, monkeypatch):
    """Embree called directly, with the trees of large meshes, and through embreex: the same answers are expected of all."""
    if request.param == "embreex":
        monkeypatch.setattr(direct, "load", lambda: None)
    elif direct.load() is None:
        pytest.skip("Embree's library cannot be called directly here")
    if request.param == "compact":
        monkeypatch.setattr(direct, "COMPACT_FROM", 1)
    return EmbreeCaster


@pytest.mark.parametrize("offset_mm", [0.0, 1e6])
@pytest.mark.parametrize("coherent", [False, True])
def test_first_hits_are_those_of_brute_force(engine, offset_mm, coherent):
    vertices, faces = bumpy_sheet()
    vertices = vertices + offset_mm
    origins, directions = rays_at(vertices, 300, seed=2)
    truth = BruteCaster(vertices, faces).closest(origins, directions)
    hits = engine(vertices, faces).closest(origins, directions, coherent=coherent)
    # a ray within float32 rounding of an edge may go either way
    same = hits.face == truth.face
    assert same.mean() > 0.99
    both = same & (truth.face >= 0)
    assert both.sum() > 150
    # lengths are taken in float64 to the plane: rounding of the coordinates over the sine of incidence
    assert np.abs(hits.distance_mm[both] - truth.distance_mm[both]).max() < 1e4 * np.spacing(offset_mm + 1000.0)
    assert np.isinf(hits.distance_mm[hits.face < 0]).all()


@pytest.mark.parametrize("coherent", [False, True])
def test_a_far_camera_loses_no_distance(engine, coherent):
    vertices, faces = bumpy_sheet()
    origins, directions = rays_at(vertices, 200, seed=3, away_mm=1e6)
    truth = BruteCaster(vertices, faces).closest(origins, directions)
    hits = engine(vertices, faces).closest(origins, directions, coherent=coherent)
    both = (hits.face == truth.face) & (truth.face >= 0)
    assert both.sum() > 20
    assert np.abs(hits.distance_mm[both] - truth.distance_mm[both]).max() < 1e4 * np.spacing(1e6)


@pytest.mark.parametrize("coherent", [False, True])
def test_something_blocks_a_ray_exactly_when_its_first_hit_lies_within_reach(engine, coherent):
    vertices, faces = bumpy_sheet()
    caster = engine(vertices, faces)
    origins, directions = rays_at(vertices, 301, seed=4)
    distance = caster.closest(origins, directions).distance_mm
    assert (caster.occluded(origins, directions, coherent=coherent) == np.isfinite(distance)).all()
    reach = np.where(np.isfinite(distance), distance, 100.0)
    assert not caster.occluded(origins, directions, 0.999 * reach, coherent=coherent).any()
    assert (caster.occluded(origins, directions, 1.001 * reach, coherent=coherent) == np.isfinite(distance)).all()
    assert not caster.occluded(origins, directions, 0.0, coherent=coherent).any()


@pytest.mark.parametrize("coherent", [False, True])
def test_a_ray_that_is_not_finite_misses_and_leaves_its_neighbours_alone(engine, coherent):
    vertices, faces = bumpy_sheet()
    caster = engine(vertices, faces)
    origins, directions = rays_at(vertices, 40, seed=5)
    whole = caster.closest(origins, directions, coherent=coherent)
    directions[7], origins[11, 2] = np.nan, np.inf
    hits = caster.closest(origins, directions, coherent=coherent)
    assert hits.face[7] == hits.face[11] == -1 and np.isinf(hits.distance_mm[[7, 11]]).all()
    others = np.delete(np.arange(40), [7, 11])
    assert (hits.face[others] == whole.face[others]).all()


def test_a_ray_that_starts_one_skin_off_a_face_does_not_hit_it(engine):
    vertices, faces = bumpy_sheet()
    for offset_mm in (0.0, 1e5):
        caster = engine(vertices + offset_mm, faces)
        corners = (vertices + offset_mm)[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        start = corners.mean(axis=1) + caster.skin_mm * normal
        assert not caster.occluded(start, normal, 1.0).any()
        # and grazing along the face, it leaves without touching it
        along = corners[:, 1] - corners[:, 0]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        assert (caster.closest(start, along).face != np.arange(len(faces))).all()


def test_light_does_not_leak_between_faces(engine):
    # a closed box seen from inside, aimed at points on its edges and diagonals
    vertices = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) * 200.0
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    rng = np.random.default_rng(6)
    ends = vertices[faces][rng.integers(0, 12, 4000)]
    weight = rng.uniform(size=(4000, 1))
    target = weight * ends[:, 0] + (1 - weight) * ends[:, 2]
    origins = rng.uniform(40, 160, (4000, 3))
    directions = (target - origins) / np.linalg.norm(target - origins, axis=1, keepdims=True)
    missed = (engine(vertices, faces).closest(origins, directions).face < 0).sum()
    assert missed == 0


def test_no_rays_and_no_faces(engine):
    vertices, faces = bumpy_sheet(2)
    caster = engine(vertices, faces)
    none = np.empty((0, 3))
    assert len(caster.closest(none, none).face) == 0 and len(caster.occluded(none, none)) == 0
    with pytest.raises(SurfaceError, match="no faces"):
        engine(vertices, faces[:0])
    with pytest.raises(SurfaceError, match="not finite"):
        engine(np.full((3, 3), np.nan), np.array([[0, 1, 2]], np.int32))
