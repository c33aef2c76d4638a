"""Directions drawn for the lobe: facets as they are seen, and that no way of drawing changes the light that is gathered."""

import math

import numpy as np
import pytest

from rangecheck.kernels import kernel
from rangecheck.reflectance import GREY_UM, Material
from rangecheck.reflectance.energy import lobe_albedo
from rangecheck.reflectance.lobe import SMITH
from rangecheck.reflectance.sampling import sample_lobe
from rangecheck.reflectance.tables import REACH, ROUGHNESS
from rangecheck.transport.reflection import draw_lobe, lobe_of, materials_of
from rangecheck.transport.slopes import masking_of_steepness, seen_slope, slope_table

#: sigma and T in micrometres: few scattering orders, several, many, and the rough limit, gentle and steep
SURFACES = ((0.1, 3.0), (0.2, 3.0), (0.5, 5.0), (2.0, 20.0), (2.0, 6.0))
_COUNT = 1 << 15


@kernel
def _drawn(materials, cosine, key, moments):
    """Rows of weight times 1, x, z of the drawn directions, the viewer at (s, 0, cosine)."""
    sine = math.sqrt(1.0 - cosine * cosine)
    for n in range(len(moments)):
        x, _y, z, density = draw_lobe(materials, 0, cosine, np.uint32(key), np.uint32(n))
        weight = lobe_of(materials, 0, 0, z, cosine, sine * x + cosine * z) * z / density if z > 0.0 else 0.0
        moments[n, 0], moments[n, 1], moments[n, 2] = weight, weight * x, weight * z


@kernel
def _by_order(materials, cosine, uniform, moments):
    """The same, drawn by scattering order alone."""
    sine = math.sqrt(1.0 - cosine * cosine)
    for n in range(len(moments)):
        x, _y, z, _aside, density = sample_lobe(
            materials.surfaces, materials.series, 0, 0, cosine, uniform[n, 0], uniform[n, 1], uniform[n, 2]
        )
        weight = lobe_of(materials, 0, 0, z, cosine, sine * x + cosine * z) * z / density if z > 0.0 else 0.0
        moments[n, 0], moments[n, 1], moments[n, 2] = weight, weight * x, weight * z


def _surface(sigma, correlation):
    material = Material("rough", K_s=1.0, sigma_um=sigma, correlation_um=correlation, bounded=False, wavelengths_um=GREY_UM)
    return materials_of((material,))


@pytest.mark.parametrize(("sigma", "correlation"), SURFACES)
def test_directions_drawn_for_the_lobe_carry_its_albedo_at_every_angle(sigma, correlation):
    materials = _surface(sigma, correlation)
    row, moments = materials.surfaces[0, 0], np.empty((_COUNT, 3))
    for cosine in (1.0, 0.7, 0.3, 0.05):
        _drawn(materials, cosine, 7, moments)
        weight = moments[:, 0]
        exact = lobe_albedo(np.array([cosine]), float(row[ROUGHNESS]), float(row[REACH]), masking=SMITH, bounded=False)[0]
        # the tracer's masking is piecewise linear in the cosine, which is off by less than 3e-4
        assert abs(weight.mean() - exact) < 4 * weight.std() / math.sqrt(_COUNT) + 3e-4 * exact


@pytest.mark.parametrize(("sigma", "correlation"), SURFACES)
def test_facets_and_scattering_orders_send_the_same_light_to_the_same_side(sigma, correlation):
    materials = _surface(sigma, correlation)
    uniform = np.random.default_rng(3).random((1 << 17, 3))
    ours, theirs = np.empty((_COUNT, 3)), np.empty((len(uniform), 3))
    _drawn(materials, 0.6, 9, ours)
    _by_order(materials, 0.6, uniform, theirs)
    error = np.sqrt(ours.var(axis=0) / len(ours) + theirs.var(axis=0) / len(theirs))
    assert (np.abs(ours.mean(axis=0) - theirs.mean(axis=0)) < 4.5 * error).all()


def test_as_many_facets_lie_below_a_drawn_slope_as_its_quantile_says():
    table = slope_table()
    for tangent in (0.0, 0.1, 0.5, 1.0, 4.0, 100.0):
        steep, root = tangent / (1.0 + tangent), tangent / math.sqrt(math.pi)
        low = -1.0 / tangent if tangent > 0.15 else -7.0
        below = math.erf(low) - root * math.exp(-low * low)
        for x in np.linspace(-3.0, 3.0, 61):
            t = seen_slope(table, steep, x)
            share = (math.erf(t) - root * math.exp(-t * t) - below) / (1.0 - below)
            # off by less than 1e-5 slope widths, at a density of less than 1 per width
            assert abs(share - 0.5 * math.erfc(-x)) < 1e-5


def test_masking_read_from_steepness_is_smiths():
    from rangecheck.reflectance.lobe import smith_masking

    table = slope_table()
    for tangent in np.geomspace(1e-3, 1e4, 200):
        steep = tangent / (1.0 + tangent)
        exact = smith_masking(1.0 / math.sqrt(1.0 + tangent * tangent), 1.0)
        assert masking_of_steepness(table, steep) * (1.0 - steep) == pytest.approx(exact, rel=1e-7)
