"""Light with a known answer, against quadrature and against counting photons."""

import math

import numpy as np
import pytest

from rangecheck.analytic.light import enclosure_radiance, irradiance_of_sphere, lit_patch_radiance, solid_angle_of_sphere
from rangecheck.errors import SceneError


def quadrature(sine, cosine, n=1500):
    """Integral of max(0, n.w) over the cone of half angle asin(sine), midpoint rule, and its own error by halving."""
    totals = []
    for m in (n, 2 * n):
        theta = math.asin(sine)
        t, p = (np.arange(m) + 0.5) / m * theta, (np.arange(m) + 0.5) / m * math.pi
        facing = np.cos(t)[:, None] * cosine + np.sin(t)[:, None] * np.cos(p) * math.sqrt(1 - cosine**2)
        totals.append(2 * float((np.maximum(facing, 0.0) * np.sin(t)[:, None]).sum()) * theta / m * math.pi / m)
    return totals[1], abs(totals[1] - totals[0])


@pytest.mark.parametrize("sine", [0.05, 0.5, 0.95])
@pytest.mark.parametrize("height", [-0.8, -0.2, 0.0, 0.4, 0.99, 1.02])
def test_irradiance_of_a_sphere_is_the_integral_over_what_is_above_the_horizon(sine, height):
    cosine = min(height * sine, 1.0)
    expected, error = quadrature(sine, cosine)
    assert irradiance_of_sphere(1.0, sine, 1.0, cosine) == pytest.approx(expected, abs=2 * error + 1e-12)


def test_irradiance_is_continuous_where_the_horizon_meets_the_sphere():
    for sine in (0.01, 0.3, 0.9):
        for edge in (-sine, sine):
            just_below, just_above = irradiance_of_sphere(1.0, sine, 1.0, np.array([edge - 1e-9, edge + 1e-9]))
            assert just_above - just_below == pytest.approx(0.0, abs=1e-8)


def test_above_the_horizon_irradiance_is_the_report_s_form():
    assert irradiance_of_sphere(2.0, 5.0, 100.0, 0.7) == pytest.approx(2.0 * math.pi * 0.0025 * 0.7, rel=1e-14)


def test_solid_angle_keeps_its_digits_for_small_sources():
    assert solid_angle_of_sphere(1e-6, 1.0) == pytest.approx(math.pi * 1e-12, rel=1e-11)
    assert solid_angle_of_sphere(1.0 - 1e-15, 1.0) == pytest.approx(2 * math.pi, rel=1e-6)
    # the report's pi r^2 / d^2 is 0.25 % low at r/d = 0.1
    assert solid_angle_of_sphere(0.1, 1.0) / (math.pi * 0.01) == pytest.approx(1.0025, abs=2e-5)


def test_a_sphere_under_a_lamp_reflects_what_a_patch_reflects():
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    radiance = lit_patch_radiance(10.0 * normals, normals, [0.0, 0.0, 110.0], 2.0, 3.0, 0.8)
    assert radiance[0] == pytest.approx(0.8 * 3.0 * (2.0 / 100.0) ** 2, rel=1e-13)
    assert radiance[1] == radiance[2] == 0.0


@pytest.mark.parametrize("scatterings", [1, 2, 5, None])
def test_an_enclosure_counts_its_scatterings(scatterings):
    # photons from the centre, each wall hit scattering by Lambert's law inside a sphere: uniform over the wall
    random = np.random.Generator(np.random.Philox(key=8))
    n, rho, flux, radius = 40000, 0.7, 12.0, 3.0
    points = random.normal(size=(n, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    weight, in_cap, bounces = np.full(n, flux / n), np.zeros(n), scatterings or 60
    cap = math.cos(0.6)
    for _ in range(bounces):
        weight = weight * rho
        in_cap += weight * (points[:, 2] > cap)
        onward = random.normal(size=(n, 3))
        onward = onward / np.linalg.norm(onward, axis=1, keepdims=True) - points
        onward /= np.linalg.norm(onward, axis=1, keepdims=True)
        points = points - 2 * (points * onward).sum(axis=1, keepdims=True) * onward
    area = 2 * math.pi * (1 - cap) * radius**2
    exitance = in_cap * n / area
    standard_error = exitance.std() / math.sqrt(n)
    assert abs(exitance.mean() - math.pi * enclosure_radiance(rho, flux, radius, scatterings)) < 5 * standard_error


def test_an_enclosure_after_many_scatterings_is_the_endless_one():
    assert enclosure_radiance(0.5, 1.0, 1.0, 80) == pytest.approx(enclosure_radiance(0.5, 1.0, 1.0), rel=1e-15)
    assert enclosure_radiance(1.0, 4 * math.pi**2, 1.0, 7) == pytest.approx(7.0)


def test_impossible_light_is_refused():
    with pytest.raises(SceneError, match="outside the source"):
        irradiance_of_sphere(1.0, 2.0, 1.0, 1.0)
    with pytest.raises(SceneError, match="below 1"):
        enclosure_radiance(1.0, 1.0, 1.0)
