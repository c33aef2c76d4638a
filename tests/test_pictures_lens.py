"""Pictures through a lens onto a sensor: only as much of it as can be seen, and that right; turntables of every kind."""

import json

import numpy as np
import pytest
from rangecheck_cli.main import exit_status

from rangecheck import rigid
from rangecheck.animation import speckle_of
from rangecheck.config import load_settings
from rangecheck.export.camera_files import read_camera_json
from rangecheck.export.meshes import write_mesh
from rangecheck.export.pictures import read_png
from rangecheck.modeler.primitives import sphere
from rangecheck.optics import PinholeCamera, ThinLens
from rangecheck.pipeline.camera import optics_of, out_of_focus, take
from rangecheck.reflectance import Material
from rangecheck.scene import Scene, Source, constant
from rangecheck.surface import Surface
from rangecheck.transport import Plan, Settings, Tracer

BODY = sphere(2.0, 0.02)
CAMERA = PinholeCamera.from_field_of_view(96, 96, 20)
DIRECT = Plan("direct", 0.0, Settings(passes=4, each=4, spike=False, lobe=False, diffuse=False, depth=1, backdrop=False), None)


def small_ball() -> Tracer:
    """A white ball of 2 mm under a far lamp."""
    lamp = Source.giving(np.pi, (0, 0, 0), (0, 0, 500), 2.0)
    scene = Scene(Surface(BODY.vertices, BODY.faces), (Material("white", K_lm=1.0),), (0,), (lamp,), constant(0.0), smooth=True)
    return Tracer(scene)


def optics(**picture):
    settings = load_settings(None, (), {f"picture.{name}": value for name, value in picture.items()})
    return optics_of(settings, CAMERA, 300.0)


def test_a_ball_out_of_focus_is_spread_over_the_thin_lens_disc_and_keeps_its_light():
    tracer, pose = small_ball(), rigid.look_at((0, 0, 300), (0, 0, 0))
    sharp, _ = take(tracer, optics(), pose, DIRECT, 1)
    through = optics(aperture_mm=30.0, focus_mm=420.0)
    blurred, said = take(tracer, through, pose, DIRECT, 1)
    assert "traced in" in said[0]
    total, spread = (film.radiance[..., 0].astype(float) for film in (sharp, blurred))
    # 64 rays through the lens for each pixel: the sum over n pixels is off by no more than its own scatter
    error = np.sqrt(blurred.variance[..., 0].sum() + sharp.variance[..., 0].sum())
    assert spread.sum() == pytest.approx(total.sum(), abs=4 * error + 0.01 * total.sum())
    # the second moment of a disc is half its radius squared, per both axes, added to the sharp picture's own
    rows, columns = np.mgrid[:96, :96]

    def moment(image):
        weight = image / image.sum()
        middle = (weight * rows).sum(), (weight * columns).sum()
        return float((weight * ((rows - middle[0]) ** 2 + (columns - middle[1]) ** 2)).sum())

    radius = np.sqrt(2 * (moment(spread) - moment(total)))
    # the lit side of the ball lies between its middle and its nearest point
    near, far = (0.5 * through.lens.circle_of_confusion_px(np.array([z]))[0] for z in (298.0, 300.0))
    assert far * 0.98 <= radius <= near * 1.02


def test_what_is_too_small_to_be_seen_is_left_out_and_said():
    tracer, pose = small_ball(), rigid.look_at((0, 0, 300), (0, 0, 0))
    film, said = take(tracer, optics(aperture_mm=1.0, focus_mm=300.0), pose, DIRECT, 1)
    assert "left out" in said[0]
    assert (film.radiance == take(tracer, optics(), pose, DIRECT, 1)[0].radiance).all()
    settings = load_settings(None, (), {"picture.distortion": (1e-4,)})
    faint = optics_of(settings, PinholeCamera(96, 96, 272.0, 272.0, 47.5, 47.5, (1e-4,)), 300.0)
    assert faint.camera.distortion == () and faint.asked.distortion == (1e-4,) and "left out" in faint.reasons[0]
    strong = optics_of(settings, PinholeCamera(96, 96, 272.0, 272.0, 47.5, 47.5, (0.2,)), 300.0)
    assert strong.camera.distortion == (0.2,) and "traced" in strong.reasons[0]


def test_only_pixels_that_a_visible_disc_reaches_are_traced_through_the_lens():
    pose = rigid.look_at((0, 0, 300), (0, 0, 0))
    marked, widest = out_of_focus(small_ball(), ThinLens(CAMERA, 30.0, 420.0), pose)
    radius = 0.5 * widest
    away = np.hypot(*(np.mgrid[:96, :96] - 47.5))
    ball_px = CAMERA.fx * 2 / 300
    assert marked[away < ball_px + radius - 1].all() and not marked[away > 2 * (ball_px + radius) + 3].any()


def test_vignetting_is_the_fourth_power_of_the_cosine():
    bright = optics(vignetting=True)
    cosine = CAMERA.pixel_rays()[1][..., 2]
    assert np.abs(bright.falloff() - cosine**4).max() < 1e-12 and optics().falloff() is None


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    body = sphere(40.0, 0.5)
    path = tmp_path_factory.mktemp("lens") / "ball.ply"
    write_mesh(Surface(body.vertices, body.faces), path)
    return path


def test_a_noisy_picture_has_its_camera_beside_it_in_three_forms(ball, tmp_path):
    out = tmp_path / "ball.png"
    options = ["--size", "48x40", "--set", "sensor.noise=true", "--set", "picture.distortion=[0.3]", "-q"]
    assert exit_status(["render", str(ball), "--unit", "mm", "-o", str(out), *options]) == 0
    camera, _, more = read_camera_json(tmp_path / "ball.camera.json")
    assert camera.distortion == (0.3,) and more["sensor"]["full_well"] == 20000 and more["exposure"] > 0
    import cv2

    stored = cv2.FileStorage(str(tmp_path / "ball.opencv.yaml"), cv2.FILE_STORAGE_READ)
    assert stored.getNode("camera_matrix").mat()[0, 0] == camera.fx
    assert "OPENCV 48 40" in (tmp_path / "ball.colmap" / "cameras.txt").read_text()
    again = tmp_path / "again.png"
    assert exit_status(["render", str(ball), "--unit", "mm", "-o", str(again), *options, "--threads", "1"]) == 0
    assert again.read_bytes() == out.read_bytes()
    assert exit_status(["render", str(ball), "--unit", "mm", "-o", str(again), *options, "--seed", "1", "--force"]) == 0
    assert again.read_bytes() != out.read_bytes()


TURN = ["--unit", "mm", "--frames", "3", "--size", "40x40", "-q"]


def turn(ball, film, *options):
    assert exit_status(["turntable", str(ball), "-o", str(film), *TURN, *options]) in (0, 1)
    return film.with_name(f"{film.stem}-frames")


def test_two_materials_turn_side_by_side_and_are_gathered_on_a_sheet(ball, tmp_path):
    sheet = tmp_path / "sheet.png"
    frames = turn(ball, tmp_path / "both.gif", "--material", "plaster", "--material", "steel", "--sheet", str(sheet))
    assert sorted(p.name for p in frames.iterdir()) == ["plaster", "steel"] and read_png(sheet).shape[1] > 3 * 40
    cameras = json.loads((frames / "steel" / "cameras.json").read_text())
    assert len(cameras["pictures"]) == 3 and (frames / "steel" / "colmap" / "images.txt").is_file()


@pytest.mark.parametrize("show", ["stripes", "distance", "id"])
def test_stripes_distances_and_ids_turn_as_well(ball, tmp_path, show):
    frames = turn(ball, tmp_path / f"{show}.apng", "--show", show)
    assert len(list(frames.glob("frame_*.png"))) == 3


def test_linear_frames_hold_distances_of_a_ball_that_a_turn_does_not_change(ball, tmp_path):
    pytest.importorskip("OpenEXR", reason="the optional package OpenEXR is not installed")
    from rangecheck.export.exr import read_exr

    frames = turn(ball, tmp_path / "far.mp4", "--show", "distance", "--frame-format", "exr", "--elevation", "0")
    maps = [read_exr(path)["distance_mm"] for path in sorted(frames.glob("*.exr"))]
    # facets lie within half a millimetre of the ball, and its border within the same of the rays through it
    inner = [m[14:26, 14:26] for m in maps]
    assert np.abs(inner[0] - inner[1]).max() < 1.0 and np.isnan(maps[0][0, 0])


def test_under_lights_of_the_room_a_turning_ball_looks_the_same_and_under_its_own_it_does_not(ball, tmp_path):
    still = turn(ball, tmp_path / "room.mp4", "--lights", "room", "--material", "plaster")
    moved = turn(ball, tmp_path / "model.mp4", "--lights", "model", "--material", "plaster")

    def change(frames):
        first, second = (read_png(path).astype(float) for path in sorted(frames.glob("frame_*.png"))[:2])
        return np.abs(first - second).mean()

    assert change(still) < 0.1 * change(moved)


def test_stripes_in_plaster_are_refused(ball, tmp_path, capsys):
    assert (
        exit_status(["turntable", str(ball), "-o", str(tmp_path / "x.mp4"), *TURN, "--show", "stripes", "--material", "plaster"])
        == 2
    )
    assert "choose steel" in capsys.readouterr().err


def test_what_a_turntable_shows_is_judged_and_drawn(ball, tmp_path):
    frames = turn(ball, tmp_path / "judged.mp4", "--material", "steel", "--consistency")
    found = json.loads((frames / "consistency.json").read_text())
    # the facets of a ball within half a millimetre: their normals are those of a smooth surface, and no scan is there to compare
    assert found["slope_noise_deg"] < 2 and found["outlines"] == {} and found["speckle"]["frames"] == 3
    # of pictures as small as these it is said that they do not tell
    assert found["standing_out"]["places"] == [] and found["standing_out"]["views"] == 3
    assert "bust of 80 mm" in found["verdict"] and (frames / "consistency_front.png").is_file()


def test_grains_that_come_and_go_are_speckle_and_a_sliding_highlight_is_not():
    rng = np.random.default_rng(0)
    away = np.hypot(*(np.mgrid[:96, :96] - 48.0))
    plain = np.where(away < 40, 90, 10).astype(np.uint8)

    def slid(k):
        spot = np.hypot(*(np.mgrid[:96, :96] - np.array([48.0, 40.0 + k])[:, None, None]))
        return np.where(spot < 6, 250, plain).astype(np.uint8)

    def grainy(_):
        return np.where((rng.random((96, 96)) < 0.02) & (away < 38), 250, plain).astype(np.uint8)

    smooth, rough = speckle_of(slid(k) for k in range(5)), speckle_of(grainy(k) for k in range(5))
    assert smooth.pieces == 1 and smooth.jumps == 0 and rough.pieces > 30 and rough.jumps > 0.5
    assert rough.contrast > 3 * smooth.contrast and speckle_of([]) is None
