"""The study of the whole job measures what it says: the distance of a part's measured faces from the bust that was scanned."""

import numpy as np
import pytest

from rangecheck import rigid
from rangecheck.config import load_settings
from rangecheck.pipeline.job_study import error_of
from rangecheck.pipeline.presets import PRESETS, finer_than, measured
from rangecheck.scan.sample import sample_view
from rangecheck.surface import INVENTED, MEASURED, Surface


@pytest.fixture(scope="module")
def truth():
    """A smooth piece of the front: true points of a view, their normals, and the triangles of its grid."""
    view = sample_view(0)
    rows, columns = slice(224, 240), slice(312, 328)
    origins, directions = view.scan.camera.pixel_rays()
    points = (origins + view.true_range_mm[..., None] * directions)[rows, columns].reshape(-1, 3)
    normals = view.true_normal[rows, columns].reshape(-1, 3)
    cell = np.arange(16 * 16).reshape(16, 16)
    a, b, c, d = (cell[i : 15 + i, j : 15 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    pose = view.scan.world_from_scan
    return rigid.move_points(pose, points), rigid.move_directions(pose, normals), faces


def test_a_surface_lifted_by_a_tenth_is_a_tenth_away(truth):
    points, normals, faces = truth
    assert np.isfinite(points).all()
    lifted = error_of(Surface(points + 0.1 * normals, faces))
    assert lifted.rms == pytest.approx(0.1, abs=0.02)  # the chords of the grid's cells sag by less


def test_what_was_invented_does_not_count(truth):
    points, normals, faces = truth
    half = points + np.where(points[:, :1] > np.median(points[:, 0]), 5.0, 0.0) * normals
    far = (half[faces] != points[faces]).any(axis=(1, 2))
    surface = Surface(half, faces, origin_of_face=np.where(far, INVENTED, MEASURED).astype(np.uint8))
    assert error_of(surface).p99 < 0.2


def test_every_preset_has_its_measured_figures_and_says_what_the_next_one_gains():
    figures = measured()
    assert [figures[name]["rms_mm"] for name in PRESETS] == sorted((figures[name]["rms_mm"] for name in PRESETS), reverse=True)
    assert [figures[name]["seconds"] for name in PRESETS] == sorted(figures[name]["seconds"] for name in PRESETS)
    said = finer_than(load_settings())
    assert said and "--preset fine" in said and f"{figures['fine']['rms_mm']:.3f}" in said
    assert "finest" in (finer_than(load_settings("fine")) or "")
    assert finer_than(load_settings(None, ["meshing.voxel_mm=3"])) is None


def test_a_file_goes_over_the_preset_that_it_starts_from(tmp_path):
    file = tmp_path / "job.toml"
    file.write_text("[turntable]\nframes = 5\n")
    settings = load_settings(file, preset="fine")
    assert (settings.turntable.frames, settings.turntable.fps, settings.picture.width) == (
        5,
        24,
        load_settings("fine").picture.width,
    )
