"""Structured light on a sphere before a plane, whose distances are known: what is decoded, how finely, and what is said of the rest."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rangecheck.errors import InputError, ScanError
from rangecheck.optics import PinholeCamera
from rangecheck.rigid import inverse, look_at, move_directions, move_points
from rangecheck.scan.decode import Pictures, Reason, View, decode_gray_code, read_capture
from rangecheck.scan.decode.capture import read_grey
from rangecheck.scan.decode.code import boundary

BITS, CELLS = 6, 64
TARGET = np.array([0.0, 0.0, 500.0])
RADIUS_MM, WALL_Z_MM = 60.0, 560.0


def view(width, height, focal, eye):
    return View(
        PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, (0.05, -0.1)),
        look_at(eye, TARGET, (0, -1, 0)),
    )


LEFT, RIGHT = view(180, 140, 420.0, (-60.0, 0.0, 0.0)), view(190, 150, 430.0, (60.0, 10.0, 0.0))
PROJECTOR = view(CELLS, CELLS, 140.0, (0.0, -80.0, 0.0))


def distances(v, fine):
    """Range (fine h, fine w) to sphere or wall along subpixel rays, and the points."""
    at = [(np.arange(n * fine) + 0.5) / fine - 0.5 for n in (v.camera.width, v.camera.height)]
    origin, direction = v.camera.rays(*np.meshgrid(*at))
    origin, direction = move_points(v.world_from_camera, origin), move_directions(v.world_from_camera, direction)
    apart = origin - TARGET
    b, c = (apart * direction).sum(-1), (apart * apart).sum(-1) - RADIUS_MM**2
    with np.errstate(invalid="ignore"):
        ball = -b - np.sqrt(b * b - c)
    away = np.where(np.isfinite(ball), ball, (WALL_Z_MM - origin[..., 2]) / direction[..., 2])
    return away, origin + away[..., None] * direction


def lit_coordinates(v, fine=4):
    """Projector column and row of each subpixel, and whether the projector's light reaches it."""
    _, points = distances(v, fine)
    uv, away = PROJECTOR.camera.project(move_points(inverse(PROJECTOR.world_from_camera), points))
    # in the sphere's shadow: the ray from the projector meets the sphere before the point
    eye = PROJECTOR.world_from_camera[:3, 3]
    toward = (points - eye) / away[..., None]
    b, c = ((eye - TARGET) * toward).sum(-1), ((eye - TARGET) ** 2).sum() - RADIUS_MM**2
    with np.errstate(invalid="ignore"):
        first = -b - np.sqrt(b * b - c)
    free = ~(first < away - 0.5)
    column, row = uv[..., 0] + 0.5, uv[..., 1] + 0.5
    inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    return column, row, free & inside


def taken(v, name, noise=1.0, gain=1.0, seed=0, fine=4):
    """The pictures that camera `v` takes: area-sampled, with a response curve, noise, and inverses brighter by `gain`."""
    column, row, lit = lit_coordinates(v, fine)
    random = np.random.default_rng(seed)

    def picture(light):
        h, w = v.camera.height, v.camera.width
        linear = (np.where(lit, light, 0.0) * 0.8 + 0.01).reshape(h, fine, w, fine).mean(axis=(1, 3))
        grey = 255 * linear ** (1 / 1.8) + random.normal(0, noise, (h, w))
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    def bits(coordinate):
        cell = np.floor(np.clip(np.nan_to_num(coordinate), 0, CELLS - 1)).astype(int)
        gray = cell ^ (cell >> 1)
        on = [(gray >> (BITS - 1 - k)) & 1 for k in range(BITS)]
        return [(picture(1.0 * o), picture(gain * (1 - o))) for o in on]

    def phase(coordinate, steps=4, period=8.0):
        return [picture(0.5 + 0.45 * np.cos(2 * np.pi * (coordinate / period - n / steps))) for n in range(steps)], period

    everywhere = np.ones(lit.shape)
    return Pictures(picture(everywhere), picture(0 * everywhere), bits(column), bits(row), phase(column), phase(row), name=name)


@pytest.fixture(scope="module")
def both():
    plain = [
        replace(taken(v, n, seed=k), column_phase=None, row_phase=None)
        for k, (v, n) in enumerate(((LEFT, "left"), (RIGHT, "right")))
    ]
    return plain


@pytest.fixture(scope="module")
def truth():
    return distances(LEFT, 1)[0]


def errors(decoded, truth):
    """Absolute range errors of valid pixels."""
    return np.abs(decoded.scan.range_mm - truth)[decoded.scan.valid]


#: what a place wrong by a tenth of a pixel in the second picture does to the range: depth^2 / (baseline focal), in mm
TENTH_PX_MM = 0.1 * 500**2 / (120 * 430)


@pytest.mark.parametrize("missing", [None, 0, 1, 3, 5])
def test_a_flip_of_one_bit_tells_its_boundary_even_with_another_bit_missing(missing):
    n, mask = 8, 0 if missing is None else 1 << missing
    for k in range(1, 1 << n):
        flipped = (k & -k).bit_length() - 1
        if (mask >> flipped) & 1:
            continue
        below = (k - 1) ^ ((k - 1) >> 1)
        assert boundary(below & ~mask, flipped, n, mask) == k
        if missing is None:
            assert boundary(k ^ (k >> 1), flipped, n, mask) == -1, "read backwards the digits contradict each other"


def test_two_cameras_find_the_sphere_and_the_wall(both, truth):
    decoded = decode_gray_code(both[0], LEFT, both[1], RIGHT)
    assert decoded.scan.valid.mean() > 0.5 and decoded.scan.camera == LEFT.camera and not decoded.lost
    found = errors(decoded, truth)
    # cells are 3 pixels wide here: a tenth of a pixel is a thirtieth of a cell
    assert np.median(found) < TENTH_PX_MM and np.percentile(found, 90) < 4 * TENTH_PX_MM
    assert np.nanmedian(decoded.both_px) < 0.1 and (decoded.both_px <= decoded.residual_px + 1e-6)[decoded.scan.valid].all()
    told, true = decoded.scan.noise_mm, np.median(found) / 0.6745
    assert 0.4 * true < told < 2.5 * true, "stated noise is that of the ranges, not that of their smooth neighbours"
    assert decoded.measured + decoded.counts()["interpolated"] == decoded.scan.valid.sum()
    assert 0.2 * decoded.measured > decoded.cells > 0.02 * decoded.measured
    assert 0.5 < np.median(decoded.scan.brightness[decoded.scan.valid]) < 1


def test_every_pixel_without_a_distance_has_its_reason(both):
    decoded = decode_gray_code(both[0], LEFT, both[1], RIGHT)
    assert ((decoded.reason == Reason.MEASURED) == decoded.scan.valid).all()
    _, _, lit = lit_coordinates(LEFT, 1)
    from scipy.ndimage import binary_erosion

    away = binary_erosion(~lit, iterations=3, border_value=1)  # the quieting blur reaches two pixels
    assert (decoded.reason[away] == Reason.SHADOW).mean() > 0.99
    assert sum(v for k, v in decoded.counts().items() if k not in ("interpolated", "cells")) == decoded.reason.size
    assert decoded.counts()["unseen"] > 0


@pytest.mark.parametrize(
    "axis, bit, which, words",
    [
        ("row", 5, (None, 1), "the pattern of row bit 5"),
        ("column", 4, (0, None), "the inverse of column bit 4"),
        ("column", 4, (None, None), "both pictures of column bit 4"),
        ("column", 5, (None, None), "both pictures of column bit 5"),
    ],
)
def test_missing_pictures_are_named_and_cost_accuracy_but_not_the_scan(both, truth, axis, bit, which, words):
    pairs = list(getattr(both[1], axis))
    pairs[bit] = tuple(None if w is None else pairs[bit][w] for w in which)
    decoded = decode_gray_code(both[0], LEFT, replace(both[1], **{axis: pairs}), RIGHT)
    assert len(decoded.lost) == 1 and words in decoded.lost[0] and "right" in decoded.lost[0]
    whole = decode_gray_code(both[0], LEFT, both[1], RIGHT)
    assert decoded.scan.valid.sum() > 0.6 * whole.scan.valid.sum()
    assert np.median(errors(decoded, truth)) < 3 * TENTH_PX_MM


def test_an_inverse_that_was_brighter_does_not_shift_the_crossings(truth):
    plain, bright = (
        decode_gray_code(*(x for k, v in enumerate((LEFT, RIGHT)) for x in (taken(v, "c", 0.5, gain, k), v)))
        for gain in (1.0, 1.1)
    )
    assert np.median(errors(bright, truth)) < 1.5 * np.median(errors(plain, truth)) + 0.2 * TENTH_PX_MM


def test_one_camera_and_a_calibrated_projector(both, truth):
    decoded = decode_gray_code(both[0], LEFT, projector=PROJECTOR)
    # a thirtieth of a cell of the projector, from its own baseline of about 100 mm
    cell_mm = 500**2 / (100 * 140) / 30
    assert np.median(errors(decoded, truth)) < cell_mm and decoded.scan.valid.mean() > 0.6
    rows_only_for_sense = decode_gray_code(replace(both[0], row=()), LEFT, projector=PROJECTOR)
    assert np.median(errors(rows_only_for_sense, truth)) < 2 * cell_mm


def test_phase_pictures_refine_the_code(truth):
    coarse = [taken(v, "c", 0.3, seed=k) for k, v in enumerate((LEFT, RIGHT))]
    fine = decode_gray_code(coarse[0], LEFT, coarse[1], RIGHT)
    plain = [replace(p, column_phase=None, row_phase=None) for p in coarse]
    assert (
        np.median(errors(fine, truth))
        < np.median(errors(decode_gray_code(plain[0], LEFT, plain[1], RIGHT), truth)) + 0.5 * TENTH_PX_MM
    )


def test_a_missing_phase_picture_is_fitted_around_and_too_few_are_left_to_the_code(truth):
    whole = [taken(v, "c", 0.3, seed=k) for k, v in enumerate((LEFT, RIGHT))]

    def without(*steps):
        fewer = []
        for pictures in whole:
            kept = [None if k in steps else p for k, p in enumerate(pictures.column_phase[0])]
            fewer.append(replace(pictures, column_phase=(kept, pictures.column_phase[1])))
        return decode_gray_code(fewer[0], LEFT, fewer[1], RIGHT)

    all_four, three, two = without(), without(1), without(1, 2)
    # three pictures know no second harmonic of the camera's response, which four let cancel: a few hundredths of a period
    assert np.median(errors(three, truth)) < np.median(errors(all_four, truth)) + TENTH_PX_MM
    coded = [replace(pictures, column_phase=None) for pictures in whole]
    alone = decode_gray_code(coded[0], LEFT, coded[1], RIGHT)
    assert np.array_equal(two.scan.range_mm, alone.scan.range_mm, equal_nan=True)
    assert all_four.lost == ()
    assert "phase picture 1 of 4 of the column is missing; the others are fitted" in three.lost[0]
    assert "phase picture 1, 2 of 4 of the column is missing; too few are left" in two.lost[0]


def test_the_finest_pictures_of_one_camera_may_be_missing(both, truth):
    whole = decode_gray_code(both[0], LEFT, both[1], RIGHT)
    coarse = replace(both[1], column=[*both[1].column[:-1], (None, None)])
    found = decode_gray_code(both[0], LEFT, coarse, RIGHT)
    assert any("both pictures of column bit 5 are missing" in said for said in found.lost)
    assert np.median(errors(found, truth)) < np.median(errors(whole, truth)) + 2 * TENTH_PX_MM
    assert found.scan.valid.sum() > 0.8 * whole.scan.valid.sum()


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda a, b: {"left": a, "left_view": LEFT}, "second eye"),
        (lambda a, b: {"left": a, "left_view": LEFT, "right": b}, "second eye"),
        (lambda a, b: {"left": a, "left_view": RIGHT, "projector": PROJECTOR}, "scale the calibration"),
        (
            lambda a, b: {"left": replace(a, white=a.black, black=a.white), "left_view": LEFT, "projector": PROJECTOR},
            "check their order",
        ),
        (
            lambda a, b: {"left": replace(a, column=[(a.black, a.black)] * 6), "left_view": LEFT, "projector": PROJECTOR},
            "no code can be read",
        ),
        (lambda a, b: {"left": replace(a, row=()), "left_view": LEFT, "right": b, "right_view": RIGHT}, "need row and column"),
        (lambda a, b: {"left": a, "left_view": LEFT, "right": replace(b, row=()), "right_view": RIGHT}, "need row and column"),
    ],
)
def test_what_cannot_be_decoded_is_refused(both, spoil, message):
    with pytest.raises(ScanError, match=message):
        decode_gray_code(**spoil(*both))


def test_pictures_of_different_sizes_are_refused(both):
    with pytest.raises(ScanError, match="all must be grey and of one size"):
        replace(both[0], black=both[1].black)
    with pytest.raises(ScanError, match="2 to 16 are decoded"):
        replace(both[0], column=[])


def described(folder, pictures, v):
    """Write pictures into `folder`; their entry of capture.json."""
    from PIL import Image

    entries = []

    def add(picture, **what):
        if picture is not None:
            name = f"{folder.name}_{len(entries)}_{pictures.name}.png"
            Image.fromarray(picture).save(folder / name)
            entries.append({"file": name} | what)

    add(pictures.white, kind="white")
    add(pictures.black, kind="black")
    for axis in ("column", "row"):
        for k, (pattern, negative) in enumerate(getattr(pictures, axis)):
            add(pattern, kind="gray", axis=axis, bit=k)
            add(negative, kind="gray", axis=axis, bit=k, inverse=True)
        phase = getattr(pictures, f"{axis}_phase")
        for k, picture in enumerate(phase[0] if phase else ()):
            add(picture, kind="phase", axis=axis, step=k, steps=len(phase[0]), period=phase[1])
    return {"camera": v.camera.to_dict(), "world_from_camera": v.world_from_camera.tolist(), "pictures": entries}


def test_a_described_capture_is_read_and_decoded_alike(tmp_path, both):
    left = taken(LEFT, "left", seed=5)
    document = {"schema": "rangecheck/capture/1", "unit": "mm", "left": described(tmp_path, left, LEFT)}
    document["projector"] = {"camera": PROJECTOR.camera.to_dict(), "world_from_camera": PROJECTOR.world_from_camera.tolist()}
    (tmp_path / "capture.json").write_text(json.dumps(document))
    capture = read_capture(tmp_path)
    found = decode_gray_code(capture.left, capture.left_view, projector=capture.projector)
    again = decode_gray_code(left, LEFT, projector=PROJECTOR)
    assert np.array_equal(found.scan.range_mm, again.scan.range_mm, equal_nan=True)
    for spoil, message in (
        ({"schema": "x"}, "is not a capture"),
        ({"unit": None}, "unit is None"),
        ({"left": {"camera": {}}}, "left has no usable camera"),
        ({"left": document["left"] | {"pictures": [{"file": "../x.png"}]}}, "outside its own folder"),
        ({"left": document["left"] | {"pictures": document["left"]["pictures"][1:]}}, "lacks a white or a black"),
        ({"right": document["left"]}, "either right or projector"),
        ({"cells": [64]}, "they are the projector's"),
    ):
        (tmp_path / "capture.json").write_text(json.dumps(document | spoil))
        with pytest.raises(InputError, match=message):
            read_capture(tmp_path)


def test_listed_pictures_that_are_not_there_are_missing_and_not_an_end(tmp_path, both):
    document = {"schema": "rangecheck/capture/1", "unit": "mm"}
    for side, pictures, v in (("left", both[0], LEFT), ("right", both[1], RIGHT)):
        (tmp_path / side).mkdir()
        entry = described(tmp_path / side, pictures, v)
        for one in entry["pictures"]:
            one["file"] = f"{side}/{one['file']}"
        document[side] = entry
    lost = [p for p in document["right"]["pictures"] if p.get("axis") == "column" and p.get("bit") == 5]
    for one in lost:
        (tmp_path / one["file"]).unlink()
    gone = replace(both[1], column=[*both[1].column[:-1], (None, None)])
    wanted = decode_gray_code(both[0], LEFT, gone, RIGHT).scan.range_mm
    (tmp_path / "capture.json").write_text(json.dumps(document))
    capture = read_capture(tmp_path)
    assert np.array_equal(decode_gray_code(*capture[:4]).scan.range_mm, wanted, equal_nan=True)
    # not listed at all: the other camera says how many bits there are
    document["right"]["pictures"] = [p for p in document["right"]["pictures"] if p not in lost]
    (tmp_path / "capture.json").write_text(json.dumps(document))
    assert np.array_equal(decode_gray_code(*read_capture(tmp_path)[:4]).scan.range_mm, wanted, equal_nan=True)
    (tmp_path / document["left"]["pictures"][0]["file"]).unlink()
    with pytest.raises(InputError, match="does not exist; left cannot be decoded without its white picture"):
        read_capture(tmp_path)


def test_the_projectors_size_says_how_many_bits_there_are(tmp_path, both, truth):
    coarse = replace(both[0], column=both[0].column[:-1])
    document = {"schema": "rangecheck/capture/1", "unit": "mm", "left": described(tmp_path, coarse, LEFT)}
    document["projector"] = {"camera": PROJECTOR.camera.to_dict(), "world_from_camera": PROJECTOR.world_from_camera.tolist()}
    (tmp_path / "capture.json").write_text(json.dumps(document))
    capture = read_capture(tmp_path)
    assert len(capture.left.column) == 6 and capture.left.column[5] == (None, None)
    found = decode_gray_code(capture.left, capture.left_view, projector=capture.projector)
    # read as if there were 5 bits, everything would lie at half its column, decimetres off
    assert np.median(errors(found, truth)) < 2 * 500**2 / (100 * 140) / 30


def test_the_last_numbered_pictures_of_one_camera_may_be_missing(tmp_path, both):
    from PIL import Image

    for side, pictures, v in (("leftCam", both[0], LEFT), ("rightCam", both[1], RIGHT)):
        (tmp_path / side).mkdir()
        shots = [pictures.white, pictures.black, *(p for pair in (*pictures.row, *pictures.column) for p in pair)]
        for number, picture in enumerate(shots if side == "leftCam" else shots[:-4]):
            Image.fromarray(picture).save(tmp_path / side / f"{number:04d}.png")
        camera_from_world = inverse(v.world_from_camera)
        numbers = {
            "Matrix": v.camera.matrix, "Distortion": [*v.camera.distortion, 0, 0, 0][:5], "Translation": camera_from_world[:3, 3],
            "Rotation": camera_from_world[:3, :3],
        }  # fmt: skip
        body = "".join(f"<{k}><data>{' '.join(repr(float(x)) for x in np.ravel(n))}</data></{k}>" for k, n in numbers.items())
        size = f"<Width>{v.camera.width}</Width><Height>{v.camera.height}</Height>"
        (tmp_path / side / "calib.xml").write_text(f"<opencv_storage><Camera>{body}{size}</Camera></opencv_storage>")
    capture = read_capture(tmp_path)
    assert len(capture.right.row) == len(capture.right.column) == BITS
    assert capture.right.column[-2:] == [(None, None)] * 2 and capture.right.column[-3][0] is not None
    assert np.array_equal(capture.right.row[0][0], both[1].row[0][0])


def test_folders_without_pictures_are_named(tmp_path):
    with pytest.raises(InputError, match="does not exist; check the name"):
        read_capture(tmp_path / "no")
    with pytest.raises(InputError, match=r"neither capture.json nor"):
        read_capture(tmp_path)
    (tmp_path / "leftCam").mkdir()
    (tmp_path / "rightCam").mkdir()
    with pytest.raises(InputError, match="lacks picture 0000"):
        read_capture(tmp_path)


@pytest.mark.real_data
def test_alexanders_bust_is_decoded_although_pictures_are_missing(real_data):
    from scipy.spatial import cKDTree

    folder = real_data / "alexander_bust"
    decoded = decode_gray_code(*read_capture(folder)[:4])
    assert len(decoded.lost) == 3
    assert decoded.scan.range_mm.shape == (1632, 2448)
    assert decoded.measured >= 500_000 and decoded.cells >= 100_000, decoded.counts()
    assert np.nanmedian(decoded.both_px) <= 0.6
    lines = (line.split() for line in (folder / "reference_cloud.obj").open() if line.startswith("v "))
    reference = np.array([[float(word) for word in words[1:4]] for words in lines])
    away = cKDTree(reference).query(decoded.scan.points_mm()[::20])[0]
    assert np.median(away) <= 0.2 and np.percentile(away, 90) <= 0.5


def test_a_grey_picture_of_sixteen_bits_keeps_its_numbers_in_every_format(tmp_path):
    counts = np.arange(0, 65536, 13, dtype=np.uint16)[:5000].reshape(50, 100)
    for name in ("counts.png", "counts.pgm"):
        cv2.imwrite(str(tmp_path / name), counts)
        for green in (False, True):
            read = read_grey(tmp_path / name, green=green)
            assert read.dtype == np.uint16 and (read == counts).all()
