"""`simulate` on meshes of any size: what comes back depends on the material, the light and the motion, and its truth is kept beside it."""

import json
import math

import numpy as np
import pytest
from rangecheck_cli.main import exit_status

from rangecheck.export.meshes import write_mesh
from rangecheck.pipeline.simulating import finish_of
from rangecheck.reflectance import load_material
from rangecheck.reflectance.material import Material
from rangecheck.scan.readers import read_scans
from rangecheck.studies.scenes import ball


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A ball of 60 mm radius, and one of 3 m."""
    folder = tmp_path_factory.mktemp("balls")
    for name, radius in (("small", 60.0), ("large", 3000.0)):
        write_mesh(ball(4, radius), folder / f"{name}.ply")
    return folder


def simulated(capsys, mesh, out, *options):
    """The JSON document of `simulate`, two views of 80x60 unless said otherwise."""
    line = ["simulate", str(mesh), "--views", "2", "--size", "80x60", "-o", str(out), "--json", "-q", *options]
    assert exit_status(line) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, mesh, out, *options):
    """The one line that the command leaves; it must leave nothing else."""
    assert exit_status(["simulate", str(mesh), "--views", "2", "--size", "80x60", "-o", str(out), "-q", *options]) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said and not out.exists()
    return said


@pytest.mark.parametrize("kind", ["stripe", "gray-code", "time-of-flight"])
def test_a_subject_of_metres_is_measured_in_the_steps_that_its_pictures_can_hold(meshes, tmp_path, capsys, kind):
    told = simulated(capsys, meshes / "large.ply", tmp_path / "out", "--kind", kind)
    scans = read_scans(told["manifest"])
    assert sum(told["valid"]) == sum(int(s.valid.sum()) for s in scans) > 1000
    step = json.loads((tmp_path / "out" / "scans.json").read_text())["scans"][0]["step"]
    assert step == pytest.approx(1.05 * (told["distance_mm"] + math.sqrt(3) * 3000) / 65535, rel=0.01)
    truth = np.load(tmp_path / "out" / "truth" / "view_00.npz")
    assert truth["reason"].size == 80 * 60 == sum(told["reasons"].values()) / 2
    if kind == "stripe":
        error = (scans[0].range_mm - truth["true_range_mm"])[scans[0].valid]
        assert np.median(np.abs(error)) < 3 * (step + 0.2)


def test_what_is_smaller_than_its_noise_is_refused(meshes, tmp_path, capsys):
    said = refused(capsys, meshes / "small.ply", tmp_path / "out", "--noise-mm", "80")
    assert "noise of 80 mm would leave nothing of it; check --unit" in said and "small.ply" in said


def test_polished_steel_is_lost_where_plaster_is_measured(meshes, tmp_path, capsys):
    reasons = {
        name: simulated(capsys, meshes / "small.ply", tmp_path / name, "--material", name)["reasons"]
        for name in ("plaster", "steel")
    }
    met = sum(n for why, n in reasons["steel"].items() if why != "nothing there")
    assert reasons["plaster"]["too dark"] == 0 < 0.8 * met < reasons["steel"]["too dark"]
    assert reasons["plaster"]["source's shadow"] == reasons["steel"]["source's shadow"]


def test_a_rough_material_has_the_lobe_of_its_slope_and_a_polished_one_that_of_its_correlation():
    rough = finish_of(Material("rough", K_s=1.0, sigma_um=3.0, correlation_um=20.0), 0.66)
    assert rough.rms_slope == pytest.approx(2 * 3 / 20) and rough.specular == pytest.approx(1.0)
    smooth = finish_of(Material("smooth", K_s=1.0, sigma_um=0.001, correlation_um=3.0), 0.66)
    g = (4 * math.pi * 0.001 / 0.66) ** 2
    assert smooth.specular == pytest.approx(g, rel=1e-3)  # the rest is the spike, which no camera sees
    assert smooth.rms_slope == pytest.approx(0.66 / (2 * math.pi * 3), rel=1e-3)
    steel, plaster = (finish_of(load_material(name), 0.66) for name in ("steel", "plaster"))
    assert steel.diffuse == 0 < steel.specular < 0.2 and plaster.diffuse == pytest.approx(0.9)


def test_a_moving_subject_and_other_light_change_what_is_measured_and_are_told(meshes, tmp_path, capsys):
    still = simulated(capsys, meshes / "small.ply", tmp_path / "still")
    moving = simulated(capsys, meshes / "small.ply", tmp_path / "moving", "--drift", "0,0,30", "--turn", "5", "--ambient", "8")
    assert still["motion"] is None and moving["motion"]["velocity_mm_s"] == [0, 0, 30]
    assert moving["instrument"]["ambient"] == 8
    errors = []
    for name in ("still", "moving"):
        scan, truth = read_scans(tmp_path / name)[0], np.load(tmp_path / name / "truth" / "view_00.npz")
        errors.append(np.abs(scan.range_mm - truth["true_range_mm"])[scan.valid].mean())
    assert errors[1] > 3 * errors[0]


@pytest.mark.parametrize("cameras", [1, 2])
def test_pictures_of_the_patterns_are_decoded_to_the_truth_beside_them(meshes, tmp_path, capsys, cameras):
    told = simulated(
        capsys, meshes / "small.ply", tmp_path / "out", "--kind", "gray-code", "--pictures", "--cameras", str(cameras), "--views", "1",
        "--size", "200x150",
    )  # fmt: skip
    assert [one.split("/")[-2] for one in told["captures"]] == ["view_00"]
    assert exit_status(["decode", str(tmp_path / "out" / "view_00"), "-o", str(tmp_path / "a.npz"), "-q"]) == 0
    (scan,) = read_scans(tmp_path / "a.npz")
    truth = np.load(tmp_path / "out" / "view_00" / "truth.npz")["true_range_mm"]
    error = np.abs(scan.range_mm - truth)[scan.valid]
    assert scan.valid.sum() > 0.8 * np.isfinite(truth).sum()
    # a cell of the projector is 2.5 pixels wide; a tenth of it, seen from a quarter of the distance beside it
    cell_mm = 2.5 * told["distance_mm"] / 275
    assert np.median(error) < 0.1 * cell_mm * 4 and scan.brightness is not None
    assert exit_status(["decode", str(tmp_path / "out"), "-o", str(tmp_path / "b.npz"), "-q"]) == 2
    assert "one by one (view_00)" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options, message",
    [
        (["--finder", "lost=1"], "a range finder has no .lost.; its numbers are source_mm"),
        (["--finder", "columns=many"], "columns is 'many'; it must be a whole number"),
        (["--finder", "source_mm=1,x,2"], "it must be three numbers"),
        (["--finder", "lost_share=2"], "lost_share is 2.0; it must lie between 0 and 1"),
        (["--finder", "farthest_mm=1"], "view_00: no cell would return a distance .* lost at random"),
        (["--pictures"], "add --kind gray-code"),
        (["--drift", "1,0,0", "--kind", "gray-code"], "moving subject spoils the code"),
        (["--material", "butter"], "butter"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_line_and_leaves_nothing(meshes, tmp_path, capsys, options, message):
    import re

    assert re.search(message, refused(capsys, meshes / "small.ply", tmp_path / "out", *options))


def test_the_noise_that_is_stated_is_the_noise_that_was_drawn(meshes, tmp_path, capsys):
    for options in (["--noise", "kinect"], ["--noise", "speckle"], ["--kind", "gray-code"]):
        simulated(capsys, meshes / "small.ply", tmp_path / options[1], *options)
        scan, truth = read_scans(tmp_path / options[1])[0], np.load(tmp_path / options[1] / "truth" / "view_00.npz")
        head_on = (truth["noise_mm"] * np.abs(truth["true_normal"] @ scan.world_from_scan[:3, 2]))[scan.valid]
        assert scan.noise_mm == pytest.approx(np.nanmedian(head_on), rel=0.2)


def test_decoding_says_why_pixels_are_empty_and_how_far_another_programs_points_lie(meshes, tmp_path, capsys):
    simulated(
        capsys, meshes / "small.ply", tmp_path / "out", "--kind", "gray-code", "--pictures", "--views", "1", "--size", "160x120"
    )
    line = ["decode", str(tmp_path / "out" / "view_00"), "-q", "--json", "-o", str(tmp_path / "scans" / "a.npz")]
    assert exit_status([*line, "--pictures"]) == 0
    told = json.loads(capsys.readouterr().out)
    (scan,) = read_scans(tmp_path / "scans")  # what is drawn beside them keeps no folder of scans from being read
    why = np.load(tmp_path / "scans" / "a_pictures" / "reasons.npz")
    assert np.array_equal(why["reason"] == 0, scan.valid) and told["against"] is None
    assert all((why["reason"] == k).sum() == told["counts"][name] for k, name in enumerate(why["names"].tolist()))
    # the same points, moved by 1 mm along x and written by somebody else
    cloud = "".join(f"v {x + 1} {y} {z}\n" for x, y, z in scan.points_mm().tolist())
    (tmp_path / "cloud.obj").write_text("# theirs\n" + cloud)
    assert exit_status([*line, "--force", "--against", str(tmp_path / "cloud.obj"), "--unit", "mm"]) == 0
    compared = json.loads(capsys.readouterr().out)["against"]
    assert compared["points"] == scan.valid.sum() and 0.2 < compared["median_mm"] <= compared["p90_mm"] <= 1.0 + 1e-6
    fewer = [*line, "--force", "--min-contrast", "0.5"]
    assert exit_status(fewer) == 0 and json.loads(capsys.readouterr().out)["valid"] < told["valid"]
