"""The study of the lobe: its truth is true, and the edges that it prints are those of the forms."""

import math

import mpmath
import pytest

from rangecheck.errors import SettingError
from rangecheck.reflectance.series import lobe_rough, lobe_smooth
from rangecheck.studies import STUDIES, study_named
from rangecheck.studies.reflectance import largest_error
from rangecheck.studies.reflectance_energy import excess
from rangecheck.studies.reflectance_forms import forty_digits
from rangecheck.study import find_edge


def test_the_truth_in_forty_digits_is_the_closed_form_in_the_mirror_direction():
    """With a = 0 the sum is e^-g (Ei(g) - ln g - gamma)."""
    with mpmath.workdps(60):
        for g in (1e-6, 0.3, 8.0, 200.0):
            closed = mpmath.exp(-g) * (mpmath.ei(g) - mpmath.log(g) - mpmath.euler)
            assert abs(mpmath.mpf(str(forty_digits(g, 0.0))) / closed - 1) < mpmath.mpf(10) ** -20


def test_the_smooth_form_leaves_one_percent_where_its_next_order_is_one_percent():
    """S(g, 0) = e^-g (g + g^2/4 + ...), so (6) is short of it by g/4."""
    edge = find_edge("smooth", lambda g: largest_error(lobe_smooth, 0.0, g), 1e-6, 10.0, 0.01, logarithmic=True, samples=15)
    assert edge.breaks_at == pytest.approx(0.04, rel=0.01)


def test_the_rough_form_leaves_one_percent_where_its_next_term_is_one_percent():
    """S(g, 0) = (1 + 1/g + 2/g^2 ...)/g, so (7) is short of it by 1/g."""
    edge = find_edge("rough", lambda g: largest_error(lobe_rough, 0.0, g), 1e5, 1.0, 0.01, logarithmic=True, samples=15)
    assert edge.breaks_at == pytest.approx(101, rel=0.01)


def test_the_published_model_makes_light_past_about_75_degrees():
    edge = find_edge("published", lambda d: excess(0.1, 3.0, d), 0.0, 89.9, 1e-3, samples=20, tolerance=1e-3)
    assert 75 < edge.breaks_at < 79 and math.isfinite(edge.holds_at)


def test_a_study_is_found_by_name():
    assert all(callable(study_named(name)) for name in STUDIES)
    with pytest.raises(SettingError, match=r"there is no study 'alchemy'; choose one of .*reflectance"):
        study_named("alchemy")
