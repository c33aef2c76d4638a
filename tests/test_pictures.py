"""Pictures: one exposure, sRGB as its standard says, legends that tell the truth, the same bytes each time."""

import json
import shutil
import subprocess

import numpy as np
import pytest

from rangecheck.errors import ArrayError, DependencyMissing, InputError, OutputError
from rangecheck.export import legend
from rangecheck.export.filming import Filming
from rangecheck.export.mapped import coloured_ids, coloured_map, contact_sheet, contour_picture, iso_lines
from rangecheck.export.pictures import (
    develop,
    exposure_from,
    png_bytes,
    read_map_png16,
    read_png,
    srgb,
    write_map_png16,
    write_png,
)
from rangecheck.export.video import FORMATS, find_encoder, write_film, write_mp4


def test_srgb_meets_the_standard_at_its_known_points():
    linear = np.array([-1.0, 0.0, 0.0031308, 0.18, 0.5, 1.0, 7.0])
    # IEC 61966-2-1: middle grey of 18 % is 0.4613561, half is 0.7353570
    np.testing.assert_allclose(srgb(linear), [0, 0, 0.04044994, 0.46135613, 0.73535698, 1, 1], atol=1e-7)
    assert (np.diff(develop(np.linspace(0, 1, 4096)[None])[0].astype(int)) >= 0).all()


def test_one_exposure_brings_the_same_share_of_all_frames_to_the_same_level():
    rng = np.random.default_rng(1)
    frames = [rng.uniform(0, 50, (64, 64)), rng.uniform(0, 100, (64, 64, 3)), np.zeros((64, 64))]
    exposure = exposure_from(frames)
    levels = np.concatenate([frames[0].ravel(), (frames[1] @ [0.2126, 0.7152, 0.0722]).ravel()]) * exposure
    assert (levels <= 0.8).mean() == pytest.approx(0.98, abs=0.001)
    assert exposure_from([1000 * f for f in frames]) == pytest.approx(exposure / 1000)
    assert exposure_from([np.zeros((4, 4))]) == 1.0


def test_background_does_not_count_for_the_exposure():
    object_only = np.full((10, 10), 3.0)
    framed = np.full((100, 100), np.nan)
    framed[40:50, 40:50] = 3.0
    assert exposure_from([framed]) == exposure_from([object_only]) == pytest.approx(0.8 / 3)
    assert develop(framed, 1.0, background=1.0)[0, 0] == 255


@pytest.mark.parametrize("bad", [np.zeros((0, 4)), np.zeros((4, 4, 2)), np.zeros((4, 4), int), np.full((2, 2), np.inf)])
def test_what_is_no_radiance_is_refused(bad):
    with pytest.raises(ArrayError, match="radiance"):
        develop(bad)


def test_a_png_holds_the_pixels_it_was_given_and_the_same_bytes(tmp_path):
    rng = np.random.default_rng(2)
    for shape, kind in (((7, 5), np.uint8), ((7, 5, 3), np.uint8), ((7, 5), np.uint16)):
        picture = rng.integers(0, np.iinfo(kind).max, shape).astype(kind)
        write_png(tmp_path / "p.png", picture, {"note": "x"})
        again = read_png(tmp_path / "p.png")
        assert (again == picture).all() and again.dtype == kind
        assert (tmp_path / "p.png").read_bytes() == png_bytes(picture, {"note": "x"})
    with pytest.raises(OutputError, match="--force"):
        write_png(tmp_path / "p.png", picture, force=False)


def test_a_map_without_a_scale_is_refused(tmp_path):
    write_png(tmp_path / "p.png", np.zeros((3, 3), np.uint16))
    with pytest.raises(InputError, match="no scale"):
        read_map_png16(tmp_path / "p.png")
    (tmp_path / "q.png").write_bytes(b"\x89PNG\r\n\x1a\n broken")
    with pytest.raises(InputError, match="not a readable PNG"):
        read_map_png16(tmp_path / "q.png")


def test_a_flat_map_and_an_empty_one_survive_sixteen_bits(tmp_path):
    flat = np.full((3, 3), 812.25)
    flat[0, 0] = np.nan
    write_map_png16(tmp_path / "flat.png", flat, "distance", "mm", note="n")
    values, scale = read_map_png16(tmp_path / "flat.png")
    np.testing.assert_array_equal(values, flat)
    assert scale["note"] == "n"
    write_map_png16(tmp_path / "none.png", np.full((3, 3), np.nan), "distance", "mm")
    assert np.isnan(read_map_png16(tmp_path / "none.png")[0]).all()


def test_ticks_are_round_numbers_with_just_the_digits_they_need():
    assert legend.tick_labels(legend.ticks(0, 1)) == ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]
    assert legend.tick_labels(legend.ticks(812.3, 1021.9)) == ["850", "900", "950", "1000"]
    assert legend.tick_labels(legend.ticks(-0.02, 0.03, 5)) == ["-0.02", "-0.01", "0.00", "0.01", "0.02", "0.03"]
    assert legend.ticks(5.0, 5.0) == [5.0]
    assert legend.span_text(1455.03, 1687.18) == "1455 to 1687"


def test_the_colour_of_a_value_is_the_colour_beside_it_on_the_scale():
    values = np.linspace(10, 20, 11).reshape(1, -1)
    colours = legend.colours_of(values, 10, 20)
    turned = legend.colours_of(values, 20, 10)
    assert (colours[0] == turned[0, ::-1]).all()
    lightness = colours.astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(lightness[0]) > 0).all()
    assert (legend.colours_of(np.array([np.nan]), 0, 1)[0] == legend.NOTHING).all()
    assert (legend.colours_of(np.array([-5.0, 99.0]), 0, 1) == legend.colours_of(np.array([0.0, 1.0]), 0, 1)).all()


def test_categories_differ_in_colour():
    colours = legend.category_colours(24).astype(int)
    apart = np.abs(colours[:, None] - colours[None]).sum(axis=2) + 1000 * np.eye(24, dtype=int)
    assert apart.min() >= 20
    assert (legend.category_colours(5) == colours[:5]).all()


def test_a_coloured_map_shows_the_map_pixel_for_pixel_inside_its_frame():
    values = np.linspace(0, 1, 700 * 700).reshape(700, 700)
    values[:50, :60] = np.nan
    picture = coloured_map(values, "Distance", "mm")
    inside = legend.colours_of(values, np.nanmin(values), 1)
    places = [
        (r, c)
        for r in range(picture.shape[0] - 699)
        for c in range(40)
        if (picture[r, c : c + 700] == inside[0]).all() and (picture[r : r + 700, c : c + 700] == inside).all()
    ]
    assert len(places) == 1
    assert picture.shape[1] > 750


def test_pictures_of_nothing_say_so_and_small_maps_are_enlarged():
    picture = coloured_map(np.full((5, 5), np.nan), "Distance", "mm")
    assert picture.shape[0] > 600
    with pytest.raises(ArrayError, match="empty"):
        coloured_map(np.zeros((0, 5)), "Distance", "mm")
    assert contour_picture(np.full((9, 9), np.nan)).shape[0] > 600
    assert contour_picture(np.full((9, 9), 5.0)).shape[0] > 600


def test_an_id_map_shows_only_names_that_are_seen():
    ids = np.zeros((20, 20), np.int32)
    ids[5:10] = 3
    few, many = coloured_ids(ids, ["a", "b", "c"], "IDs"), coloured_ids(ids, ["a" * 90, "b", "c"], "IDs")
    assert few.shape == many.shape
    with pytest.raises(ArrayError, match="there are 2 names"):
        coloured_ids(ids, ["a", "b"], "IDs")


def test_iso_lines_of_a_cone_are_circles_at_their_level():
    v, u = np.mgrid[0:101, 0:101] - 50.0
    depth = np.hypot(u, v)
    lines = iso_lines(depth, 10.0)
    assert set(lines) == {k * 10.0 for k in range(1, 8)}
    for level in (10.0, 20.0, 40.0):
        (circle,) = lines[level]
        # linear interpolation of a circle of radius r across a unit cell is off by at most 1 / (8 r)
        np.testing.assert_allclose(np.hypot(*(circle - 50).T), level, atol=1 / (8 * level) + 1e-9)
        assert (circle[0] == circle[-1]).all()


def test_iso_lines_stop_at_an_edge_of_the_scene():
    depth = np.tile(np.linspace(0, 9, 40), (40, 1))
    depth[20:] += 500
    across = iso_lines(depth, 1.0, jump=50)
    assert max(across) == 508 and min(across) == 1
    assert all(level <= 9 or level >= 500 for level in across)
    for lines in across.values():
        for line in lines:
            assert not ((line[:, 1].min() < 19.001) and (line[:, 1].max() > 19.999))
    with pytest.raises(ArrayError, match="larger step"):
        iso_lines(depth, 0.001)


def test_a_contact_sheet_holds_every_picture():
    pictures = [np.full((30, 40), 10 * k, np.uint8) for k in range(1, 8)]
    sheet = contact_sheet(pictures, [f"{k}" for k in range(7)], columns=3, cell_px=120)
    for k in range(1, 8):
        assert (sheet == 10 * k).all(axis=2).sum() >= 120 * 90
    with pytest.raises(ArrayError, match="no pictures"):
        contact_sheet([])


def moving(frames=6, h=33, w=41):
    v, u = np.mgrid[0:h, 0:w]
    return [np.stack([(u * 5 + 9 * k) % 256, v * 7 % 256, 0 * u + 90], axis=2).astype(np.uint8) for k in range(frames)]


@pytest.mark.parametrize("suffix", sorted(FORMATS))
def test_films_have_the_frames_they_were_given_and_the_same_bytes(tmp_path, suffix):
    frames = moving()
    for name in "ab":
        write_film(frames, tmp_path / f"{name}{suffix}", fps=12)
    first = (tmp_path / f"a{suffix}").read_bytes()
    assert first == (tmp_path / f"b{suffix}").read_bytes()
    played = subprocess.run(
        [find_encoder(suffix), "-v", "error", "-i", str(tmp_path / f"a{suffix}"), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
        capture_output=True,
        check=True,
    ).stdout
    h, w = (34, 42) if suffix in (".mp4", ".webm") else (33, 41)
    shown = np.frombuffer(played, np.uint8).reshape(-1, h, w, 3)
    assert len(shown) == len(frames)
    # chroma is stored at half resolution and the codecs are lossy: compare the mean colour of each frame
    for picture, original in zip(shown, frames):
        error = picture[:33, :41].reshape(-1, 3).mean(axis=0) - original.reshape(-1, 3).mean(axis=0)
        assert np.abs(error).max() < 4


def test_a_film_made_beside_its_frames_is_the_one_made_after_them(tmp_path):
    frames = [np.full((16, 24), 40 * k, np.uint8) for k in range(5)]
    write_film(frames, tmp_path / "after.mp4")
    with Filming(tmp_path / "beside.mp4", 24.0, 5, frames.__getitem__) as filming:
        for index in (3, 0, 4, 2, 1):
            filming.stands(index)
        filming.finish()
    assert (tmp_path / "beside.mp4").read_bytes() == (tmp_path / "after.mp4").read_bytes()
    with pytest.raises(KeyboardInterrupt), Filming(tmp_path / "never.mp4", 24.0, 5, frames.__getitem__) as filming:
        filming.stands(0)
        raise KeyboardInterrupt
    assert sorted(path.name for path in tmp_path.iterdir()) == ["after.mp4", "beside.mp4"]


def test_an_mp4_can_be_played_while_it_loads(tmp_path):
    write_mp4(moving(), tmp_path / "x.mp4")
    content = (tmp_path / "x.mp4").read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")


def test_films_refuse_what_they_cannot_be_made_of_and_leave_nothing_behind(tmp_path):
    target = tmp_path / "x.mp4"
    with pytest.raises(ArrayError, match="no frames"):
        write_mp4([], target)
    with pytest.raises(ArrayError, match="a film has one"):
        write_mp4([*moving(2), np.zeros((8, 8), np.uint8)], target)
    with pytest.raises(ArrayError, match="fps is nan"):
        write_mp4(moving(1), target, float("nan"))
    with pytest.raises(ArrayError, match="films end in"):
        write_film(moving(1), tmp_path / "x.avi")
    with pytest.raises(OutputError, match=r"must end in \.mp4"):
        write_mp4(moving(1), tmp_path / "x.gif")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_encoder_is_named_before_the_first_frame(monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", shutil.which("true") or "/bin/true")
    with pytest.raises(DependencyMissing, match=r"libx264.*pip install imageio-ffmpeg"):
        find_encoder(".mp4")
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/no/such/ffmpeg")
    with pytest.raises(DependencyMissing, match="ffmpeg is needed"):
        find_encoder(".mp4")


def test_metadata_of_a_map_is_json(tmp_path):
    from PIL import Image

    write_map_png16(tmp_path / "m.png", np.array([[1.0, 2.0]]), "depth", "mm", focal_point_mm=[1, 2, 3])
    with Image.open(tmp_path / "m.png") as image:
        assert json.loads(image.text["rangecheck"])["focal_point_mm"] == [1, 2, 3]
