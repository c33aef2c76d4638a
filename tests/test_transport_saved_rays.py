"""Rays that need not be cast, and light that is known without: neither changes what a picture shows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_transport import WHITE, ball, floor, lamp, looking

from rangecheck import rigid
from rangecheck.optics import OrthographicCamera
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import Scene, constant
from rangecheck.surface.surface import join
from rangecheck.transport import Settings, Tracer
from rangecheck.transport.adaptive import Exposure
from rangecheck.transport.camera_rays import pixel_order

BEHIND = lamp((60, 80, -200), 12.0, 5.0)
SIDE = lamp((150, 120, 60), 20.0, 30.0)


def things():
    return join([floor(120.0, -50.0), ball(3)])


@pytest.mark.parametrize(
    "camera, pose",
    [
        looking(64, 48),
        looking(64, 48, eye=(0, 900, 10)),
        # in the middle of everything: the floor reaches behind the camera
        looking(48, 48, fov=70.0, eye=(0, 0, 58), at=(200, -30, 58)),
        (OrthographicCamera(60, 60, 4.0, 29.5, 29.5), rigid.look_at(np.array([200.0, 90, 100]), np.zeros(3))),
    ],
)
def test_rays_outside_the_outline_meet_nothing(camera, pose):
    tracer = Tracer(Scene(things(), (WHITE,), sources=(BEHIND,)))
    picture = tracer.picture_rays(camera, pose)
    outline = tracer.may_see(picture, Settings(backdrop=False))
    chance = np.random.default_rng(4)
    pixels = np.repeat(np.arange(camera.width * camera.height), 8)
    u, v = (p + chance.uniform(-0.5, 0.5, len(pixels)) for p in (pixels % camera.width, pixels // camera.width))
    origin, direction = np.empty((2, len(pixels), 3), np.float32)
    picture.fill(u, v, origin, direction)
    hits = tracer.caster.closest(
        *(np.asarray(a, float) for a in (origin * tracer.caster.scale_mm + tracer.caster.centre_mm, direction))
    )
    assert outline[pixels[hits.face >= 0]].all()
    if camera.width == 64:
        assert outline.mean() < 0.8


def test_what_lies_outside_the_outline_is_seen_all_the_same():
    camera, pose = looking(64, 48, fov=40.0)
    for around in (constant(0.0), constant(0.2)):
        scene = Scene(ball(3), (WHITE,), sources=(BEHIND, SIDE), surroundings=around)
        saved, whole = Tracer(scene), Tracer(scene)
        whole.may_see = lambda picture, settings: None
        for settings in (Settings(passes=3, depth=2), Settings(depth=1, diffuse=False, backdrop=False)):
            one, other = (tracer.render(camera, pose, settings, seed=2) for tracer in (saved, whole))
            for name in ("radiance", "coverage", "variance", "samples"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            np.testing.assert_allclose(one.budget, other.budget, rtol=1e-6, atol=1e-12)
    # the lamp behind the ball is in view
    assert one.radiance.max() == pytest.approx(5.0)


def test_light_known_to_arrive_leaves_the_mean_of_soft_shadows_as_it_is():
    scene = Scene(
        things(), (Material("white", K_lm=0.8, wavelengths_um=GREY_UM),), sources=(SIDE, lamp((-120, 200, 90), 40.0, 8.0))
    )
    tracer, (camera, pose) = Tracer(scene), looking(24, 24, fov=26.0, eye=(0, 60, 290))
    settings = Settings(depth=1, spike=False, lobe=False, diffuse=False)
    pixels = pixel_order(24, 24)
    pictures, cast = [], []
    for seed in range(48):
        exposure = Exposure(tracer, camera, pose, settings, seed=seed)
        exposure._plate.erase(pixels)
        for first, more in ((0, 2), (2, 14)):
            exposure._sight.settle()
            tracer.expose(
                exposure._picture,
                pixels,
                exposure._settings,
                seed,
                exposure._plate,
                first,
                np.full(len(pixels), more),
                exposure._sight,
            )
        pictures.append(exposure._plate.mean.reshape(24, 24).astype(float))
        cast.append(int(exposure._sight.lit.sum(dtype=np.int64) + exposure._sight.dark.sum(dtype=np.int64)))
        settled = (exposure._sight.settled > 0).mean()
    assert settled > 0.3 and max(cast) < 0.8 * 2 * 65 * 24 * 24
    truth = [tracer.render(camera, pose, replace(settings, passes=48, each=64), seed=900 + k).radiance[..., 0] for k in range(2)]
    mean = np.mean(pictures, axis=0)
    deviation = np.std(pictures, axis=0, ddof=1) / math.sqrt(len(pictures))
    z = (mean - np.mean(truth, axis=0)) / np.hypot(deviation, 2e-4 * mean.max())
    # 576 pixels: one in a thousand runs would show 5; the mean of z is known to 1/24
    assert abs(z).max() < 5.0 and abs(z.mean()) < 4.0 / 24
