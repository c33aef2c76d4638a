"""An independent renderer (Mitsuba 3) and this one agree pixel by pixel within their noise."""

import math

import numpy as np
import pytest
from test_transport import ball, floor, lamp, looking

from rangecheck.errors import SceneError
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.scene import Scene, constant, gradient
from rangecheck.surface.surface import join
from rangecheck.transport import Settings, Tracer
from rangecheck.transport.outside import OutsideRenderer

PLASTER = Material("plaster", K_lm=0.8, wavelengths_um=GREY_UM)
#: the rough limit, in which our lobe is Beckmann's microfacet form and no spike is left
ROUGH = Material("rough", K_s=0.9, sigma_um=2.0, correlation_um=20.0, bounded=False, wavelengths_um=GREY_UM)


def probability_of(z):
    """Two-sided probability of a normal number beyond |z|."""
    return math.erfc(abs(z) / math.sqrt(2))


@pytest.mark.parametrize(
    "material, sky, systematic", [(PLASTER, 0.0, 0.0), (ROUGH, 0.2, 0.007)], ids=["plaster", "rough conductor"]
)
def test_every_pixel_agrees_with_mitsuba_within_the_noise_of_both(material, sky, systematic):
    pytest.importorskip("mitsuba", reason="the outside renderer is not installed: pip install 'rangecheck[compare]'")
    both = join([floor(), ball(3, 40.0, (0, 40, 0))])
    scene = Scene(
        both, (material,), sources=(lamp((150, 250, 100), 30, 20.0), lamp((-200, 150, 50), 20, 30.0)), surroundings=constant(sky)
    )
    camera, pose = looking(24, 24, fov=30.0, eye=(0, 150, 300), at=(0, 30, 0))
    outside = OutsideRenderer(scene, camera, pose, depth=3)
    pictures = np.array([outside.render(64, seed=k)[..., :1] for k in range(16)])
    theirs, their_variance = pictures.mean(axis=0), pictures.var(axis=0, ddof=1) / len(pictures)
    ours = Tracer(scene).render(camera, pose, Settings(passes=48, each=4, depth=3, roulette_from=0))
    # Mitsuba's Smith masking is a rational fit, good to 0.35 % for each of two directions
    variance = their_variance + ours.variance + (systematic * theirs) ** 2
    z = ((ours.radiance - theirs) / np.sqrt(variance + 1e-14)).ravel()
    # Sidak: the worst of n independent pixels, at a level of one in a thousand; spreads from 16 pictures have heavier tails than a normal
    # law, which Student's with 15 degrees of freedom describes
    from scipy.stats import t

    assert np.abs(z).max() < t.isf(0.5 * (1 - (1 - 1e-3) ** (1 / z.size)), 15)
    # and there is no bias in the mean of the frame
    error = math.sqrt(variance.sum()) / variance.size + systematic * float(theirs.mean())
    assert abs(ours.mean_radiance - float(theirs.mean())) < 4 * error


def test_what_cannot_be_compared_is_refused():
    pytest.importorskip("mitsuba", reason="the outside renderer is not installed: pip install 'rangecheck[compare]'")
    camera, pose = looking(8, 8)
    with pytest.raises(SceneError, match="constant surroundings"):
        OutsideRenderer(Scene(floor(), (PLASTER,), surroundings=gradient(0.0, 1.0)), camera, pose, depth=2)
    bounded = Material("bounded", K_s=0.9, sigma_um=2.0, correlation_um=20.0, wavelengths_um=GREY_UM)
    with pytest.raises(SceneError, match="bounded must be a perfect conductor's rough lobe alone"):
        OutsideRenderer(Scene(floor(), (bounded,)), camera, pose, depth=2)
