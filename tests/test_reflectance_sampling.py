"""Directions drawn by scattering order follow the lobe: chi-square against quadrature, order by order and weight by weight."""

import math

import numpy as np
import pytest
from scipy import stats

from rangecheck.errors import ArrayError
from rangecheck.kernels import kernel, threads
from rangecheck.reflectance import directional_albedo, load_material, lobe_brdf, sample_scattering, spike_reflectance
from rangecheck.reflectance.sampling import normal_quantile, sample_lobe, scattering_order
from rangecheck.reflectance.tables import lobe_value

GREEN = 0.555
SURFACES = [(0.02, 3.0), (0.1, 3.0), (0.3, 5.0), (1.0, 10.0)]
#: one false alarm in a thousand over all the chi-square tests of this file together
LEVEL = 1e-3 / 24


def bins_around_mirror(theta, sigma, correlation):
    """Edges of rings around the mirror direction, in tangential length, that hold most of the lobe and stay inside the hemisphere."""
    g = (4 * math.pi * sigma / GREEN * math.cos(theta)) ** 2
    width = math.sqrt(max(1.0, g)) * GREEN / (math.pi * correlation)
    reach = min(2.2 * width, 0.995 * (1 - math.sin(theta)))
    return np.linspace(0, reach, 6)


@pytest.mark.parametrize(("sigma", "correlation"), SURFACES)
@pytest.mark.parametrize("degrees", [5.0, 40.0, 70.0])
def test_samples_pass_chi_square_against_the_quadrature_of_the_lobe(sigma, correlation, degrees):
    theta, n, sectors = math.radians(degrees), 150_000, 8
    surface = {"sigma_um": sigma, "correlation_um": correlation, "wavelength_um": GREEN}
    drawn = sample_scattering(theta, n, seed=11, **surface)
    x, y = drawn.directions[:, 0] - math.sin(theta), drawn.directions[:, 1]
    rings = bins_around_mirror(theta, sigma, correlation)
    scattered = (drawn.order > 0) & (drawn.directions[:, 2] > 0)
    ring = np.searchsorted(rings, np.hypot(x, y), side="right") - 1
    sector = np.floor((np.arctan2(y, x) / (2 * np.pi) % 1.0) * sectors).astype(int) % sectors
    inside = scattered & (ring >= 0) & (ring < len(rings) - 1)
    box = ring[inside] * sectors + sector[inside]
    count = (len(rings) - 1) * sectors
    total = np.bincount(box, drawn.weights[inside], count) / n
    square = np.bincount(box, drawn.weights[inside] ** 2, count) / n
    error2 = (square - total**2) / n

    # integral of f over tangential area = integral of f cos over solid angle, by 16 x 16 Gauss points in each box
    points, gauss = np.polynomial.legendre.leggauss(16)
    expected = np.empty(count)
    for k in range(count):
        low, high = rings[k // sectors], rings[k // sectors + 1]
        length = low + (high - low) * 0.5 * (1 + points)[:, None]
        around = 2 * np.pi * (k % sectors + 0.5 * (1 + points))[None] / sectors
        px, py = math.sin(theta) + length * np.cos(around), length * np.sin(around)
        value = lobe_brdf(theta, np.arcsin(np.hypot(px, py)), np.arctan2(py, px), **surface)
        expected[k] = (value * length * gauss[:, None] * gauss[None]).sum() * 0.5 * (high - low) * np.pi / sectors
    chi2 = ((total - expected) ** 2 / error2).sum()
    assert stats.chi2.sf(chi2, count) > LEVEL
    # the boxes hold something worth testing
    assert (
        expected.sum()
        > 0.25
        * directional_albedo(theta, masking="none", bounded=False, **surface)
        * (1 - math.exp(-((4 * math.pi * sigma / GREEN * math.cos(theta)) ** 2)))
        or degrees == 70.0
    )


@pytest.mark.parametrize(("sigma", "correlation"), SURFACES)
def test_orders_follow_the_poisson_law_and_order_0_is_the_spike(sigma, correlation):
    theta, n = math.radians(30.0), 200_000
    surface = {"sigma_um": sigma, "correlation_um": correlation, "wavelength_um": GREEN}
    drawn = sample_scattering(theta, n, seed=12, **surface)
    mean = (4 * math.pi * sigma / GREEN * math.cos(theta)) ** 2
    edges = np.unique(stats.poisson.ppf(np.linspace(0.02, 0.98, 25), mean)).astype(int)
    below = np.searchsorted(edges, drawn.order)
    share = np.diff(np.concatenate([[0.0], stats.poisson.cdf(edges, mean), [1.0]]))
    counts = np.bincount(below, minlength=len(share))
    assert stats.chisquare(counts, n * share).pvalue > LEVEL
    spike = drawn.order == 0
    np.testing.assert_allclose(drawn.directions[spike] - [math.sin(theta), 0, math.cos(theta)], 0, atol=1e-15)
    assert (drawn.weights[spike] == 1).all()
    expected = float(spike_reflectance(theta, sigma_um=sigma, wavelength_um=GREEN))
    assert abs(spike.mean() - expected) < 5 * math.sqrt(expected * (1 - expected) / n) + 1e-12


@pytest.mark.parametrize("masking", ["none", "smith", "v-groove"])
@pytest.mark.parametrize("bounded", [False, True])
def test_the_mean_weight_is_the_directional_albedo(masking, bounded):
    surface = {"sigma_um": 0.1, "correlation_um": 3.0, "wavelength_um": GREEN, "masking": masking, "bounded": bounded}
    for degrees in (0.0, 50.0):
        theta = math.radians(degrees)
        drawn = sample_scattering(theta, 200_000, seed=13, **surface)
        error = drawn.weights.std() / math.sqrt(len(drawn.weights))
        assert abs(drawn.weights.mean() - directional_albedo(theta, **surface)) < 5 * error


@kernel
def _estimate(surfaces, series, wave, drawn_at, c_v, uniform, out):
    for n in range(uniform.shape[0]):
        _x, _y, z, sxy2, density = sample_lobe(surfaces, series, 0, drawn_at, c_v, uniform[n, 0], uniform[n, 1], uniform[n, 2])
        if z > 0.0:
            out[n] = lobe_value(surfaces, series, 0, wave, z, c_v, sxy2) * z / density


def test_a_direction_drawn_for_one_wavelength_serves_the_others():
    satin = load_material("steel_satin")
    surfaces, series = satin.tables()
    uniform = np.random.default_rng(14).random((200_000, 3))
    c_v = math.cos(math.radians(40))
    for wave in range(3):
        estimates = []
        for drawn_at in (wave, 0):
            out = np.zeros(len(uniform))
            _estimate(surfaces, series, wave, drawn_at, c_v, uniform, out)
            estimates.append((out.mean(), out.var() / len(out)))
        (own, own_error2), (other, other_error2) = estimates
        assert abs(own - other) < 5 * math.sqrt(own_error2 + other_error2)


def test_the_quantiles_are_those_of_the_laws():
    p = np.linspace(0.0005, 0.9995, 1999)
    ours = np.array([normal_quantile(x) for x in p])
    np.testing.assert_allclose(ours, stats.norm.ppf(p), atol=2e-8)
    for mean in (0.01, 3.0, 23.9, 24.1, 400.0, 1e7):
        orders = np.array([scattering_order(mean, x, 0) for x in p])
        # the expansion may round the other way where p falls on a step of the law, within 1e-4 of its probability
        assert (orders != stats.poisson.ppf(p, mean)).sum() <= 2
    assert scattering_order(1e-12, 0.999, 1) == 1 and scattering_order(0.0, 0.5, 0) == 0


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads():
    surface = {"sigma_um": 0.1, "correlation_um": 3.0, "wavelength_um": GREEN}
    with threads(1):
        one = sample_scattering(0.5, 20_000, seed=15, **surface)
    with threads(3):
        three = sample_scattering(0.5, 20_000, seed=15, **surface)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(one, three))
    assert sample_scattering(0.5, 20_000, seed=16, **surface).weights.tobytes() != one.weights.tobytes()


def test_samples_leave_upwards_with_unit_length_or_not_at_all():
    drawn = sample_scattering(math.radians(85), 50_000, seed=17, sigma_um=1.0, correlation_um=10.0, wavelength_um=GREEN)
    length = np.linalg.norm(drawn.directions, axis=1)
    lost = length == 0
    assert 0 < lost.mean() < 0.9 and (drawn.weights[lost] == 0).all()
    np.testing.assert_allclose(length[~lost], 1, atol=1e-12)
    assert (drawn.directions[~lost, 2] > 0).all() and (drawn.weights >= 0).all()


def test_an_angle_below_the_surface_is_refused():
    with pytest.raises(ArrayError, match=r"theta_i spans 1\.7 to 1\.7"):
        sample_scattering(1.7, 10, seed=0, sigma_um=0.1, correlation_um=3.0, wavelength_um=GREEN)
