"""The sum over scattering orders, against arithmetic of forty digits, and the forms that stand in for it."""

import math
import os
import subprocess
import sys

import mpmath
import numpy as np
import pytest

from rangecheck.kernels import kernel
from rangecheck.reflectance.fast import FAST_ERROR, lobe_fast, lobe_table
from rangecheck.reflectance.series import lobe_rough, lobe_series, lobe_smooth, log_lobe_series

DIGITS = 40


def forty_digits(g, a):
    """S(g, a): every order where the terms span few, else every h-th times h with h a quarter of their width (Poisson's summation
    formula puts the difference at 2 exp(-32 pi^2), below 1e-136)."""
    with mpmath.workdps(DIGITS):
        g, a = mpmath.mpf(g), mpmath.mpf(a)

        def term(m):
            return mpmath.exp(m * mpmath.log(g) - mpmath.loggamma(m + 1) - mpmath.log(m) - a / m - g)

        best = 1
        low, high = 1.0, 1e12
        for _ in range(200):  # the largest term: bisection of the slope of its logarithm
            best = math.sqrt(low * high)
            slope = math.log(float(g)) - math.log(best) - 1.5 / best + float(a) / best**2
            low, high = (best, high) if slope > 0 else (low, best)
        first = max(1, round(best))
        width = math.sqrt(1.0 / (1.0 / best + 2.0 * float(a) / best**3))
        stride = 1 if width < 25 else int(width / 4)
        total = term(mpmath.mpf(first))
        for sign in (1, -1):
            m = first + sign * stride
            while m >= 1:
                more = term(mpmath.mpf(m))
                total += more
                if more < total * mpmath.mpf(10) ** -25:
                    break
                m += sign * stride
        return total * stride


def points(count, seed):
    """(g, a) spread evenly in their logarithms over g 1e-12..1e8, a 0..1e8, where S exceeds 1e-290."""
    rng = np.random.default_rng(seed)
    found = [
        (1e-12, 0.0),
        (1e8, 0.0),
        (1e8, 1e8),
        (1.0, 0.0),
        (1e-12, 2400.0),
        (700.0, 0.0),
        (709.0, 4e5),
        (64.0, 10.0),
        (5e4, 1e6),
    ]
    while len(found) < count:
        g = 10 ** rng.uniform(-12, 8)
        a = 10 ** rng.uniform(-6, 8) if rng.random() < 0.5 else (1 + g) * 10 ** rng.uniform(-3, 3)
        if a <= 1e8 and log_lobe_series(g, a) > -290 * math.log(10):
            found.append((g, a))
    return found


def test_the_series_agrees_with_forty_digits_over_sixteen_decades():
    worst = max(abs(float(mpmath.mpf(lobe_series(g, a)) / forty_digits(g, a) - 1)) for g, a in points(100, 1))
    assert worst < 1e-9  # the rule; measured 2e-13, from exponents near 667 in float64


@kernel
def _fill(table, g, a, fast, exact):
    for n in range(g.size):
        fast[n] = lobe_fast(table, g[n], a[n])
        exact[n] = log_lobe_series(g[n], a[n])


def test_the_table_stays_within_its_stated_error_of_the_series():
    rng = np.random.default_rng(2)
    n = 300_000
    g = 10 ** rng.uniform(-12, 8, n)
    a = np.where(rng.random(n) < 0.5, 10 ** rng.uniform(-4, 8, n), np.minimum((1 + g) * 10 ** rng.uniform(-3, 4.5, n), 1e8))
    a[:1000] = 0.0
    fast, exact = np.empty(n), np.empty(n)
    _fill(lobe_table(), g, a, fast, exact)
    normal = exact > -290 * math.log(10)
    error = np.abs(np.log(fast[normal]) - exact[normal])
    assert normal.sum() > n / 2
    assert error.max() < FAST_ERROR
    # where the lobe carries light at all it is much closer, on which the energy bound's margin rests
    bright = a[normal] < 10 * (1 + g[normal])
    assert error[bright].max() < 1e-4


@pytest.mark.parametrize("g", [0.0, 1e-300, 1e-20, 2.0**-40, 1.0, 2.0**27, 1e9, 1e30])
@pytest.mark.parametrize("a", [0.0, 1e-300, 1.0, 1e9, math.inf])
def test_every_form_is_finite_and_not_negative_at_the_edges_of_its_range(g, a):
    for value in (lobe_series(g, a), lobe_smooth(g, a), lobe_fast(lobe_table(), g, a)):
        assert 0.0 <= value <= max(1.0, g)
    assert math.isclose(lobe_fast(lobe_table(), g, a), lobe_series(g, a), rel_tol=FAST_ERROR, abs_tol=1e-290)


def test_not_a_number_stays_not_a_number():
    for g, a in ((math.nan, 1.0), (1.0, math.nan), (-1.0, 1.0)):
        assert math.isnan(lobe_series(g, a))
    assert math.isnan(lobe_fast(lobe_table(), math.nan, 1.0)) and math.isnan(lobe_fast(lobe_table(), 1.0, math.nan))


def test_smooth_and_rough_forms_are_the_limits_of_the_series():
    # the next order of (6) is g/4 e^(a/2) of the first, that of (7) is (1 - z)/g with z = a/g, up to z^2/(2 g)
    for g in (1e-9, 1e-6, 1e-3):
        for a in (0.0, 1.0, 5.0):
            assert abs(lobe_series(g, a) / lobe_smooth(g, a) - 1) < 0.3 * g * math.exp(a / 2)
    for g in (1e3, 1e5, 1e8):
        for z in (0.0, 1.0, 5.0):
            assert abs(lobe_series(g, z * g) / lobe_rough(g, z * g) - 1) < (2 + 5 * z + z * z) / g


def test_kernels_give_the_same_numbers_without_the_compiler(tmp_path):
    script = (
        "from rangecheck.reflectance.series import lobe_series\n"
        "from rangecheck.reflectance import fast\n"
        "from rangecheck.reflectance.lobe import smith_masking, lobe_geometry\n"
        "from rangecheck.reflectance.sampling import scattering_order\n"
        "import numpy as np, sys\n"
        "table = np.load(sys.argv[1])\n"
        "for g, a in ((1e-6, 2.0), (0.7, 3.0), (40.0, 90.0), (3e4, 1e5)):\n"
        "    print(float(lobe_series(g, a)).hex(), float(fast.lobe_fast(table, g, a)).hex())\n"
        "print(float(smith_masking(0.1, 0.3)).hex(), float(lobe_geometry(9.0, 0.3, 0.4, 0.1)).hex())\n"
        "print(scattering_order(3.0, 0.7, 0), scattering_order(300.0, 0.7, 1))\n"
    )
    path = tmp_path / "table.npy"
    np.save(path, lobe_table())
    said = [
        subprocess.run(
            [sys.executable, "-c", script, str(path)],
            env={**os.environ, "NUMBA_DISABLE_JIT": off},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.split()
        for off in ("0", "1")
    ]
    for compiled, plain in zip(*said):
        if "x" in compiled:
            assert math.isclose(float.fromhex(compiled), float.fromhex(plain), rel_tol=1e-12)
        else:
            assert compiled == plain
    assert len(said[0]) == 12
