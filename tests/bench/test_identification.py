"""The benchmark of identification counts rightly; that a search finds what was planted is tested with the search."""

from types import SimpleNamespace

import numpy as np
import pytest

from ce_gym.bench.accuracy import identification
from ce_gym.identify.figures import Figure
from ce_gym.identify.separable import Held


def test_of_normal_errors_95_percent_are_covered_and_what_is_held_is_not_counted():
    rng = np.random.default_rng(0)
    std = np.tile([0.01, 0.02, 0.0], (20000, 1))
    errors = std * rng.normal(size=std.shape) + [0.0, 0.02, 0.5]  # the second is off by one standard deviation
    good, biased, both = identification.tabulate(["good", "biased", "held"], errors, std)
    assert good[:3] == ("good", 20000, pytest.approx(0.95, abs=0.005))
    assert good[3:6] == (pytest.approx(1.0, abs=0.02), pytest.approx(0.01, rel=0.02), pytest.approx(0.01))
    assert biased[2] == pytest.approx(0.8299, abs=0.01)  # Phi(0.96) - Phi(-2.96)
    assert both[:3] == ("all", 40000, pytest.approx((good[2] + biased[2]) / 2))


def test_the_truth_of_a_combination_is_the_planted_one():
    rotor, link = (Figure(kind, "a", 1.0, 1.0, 0.02, 50.0, 1.0, 0) for kind in ("rotor_inertia", "link_inertia"))
    found = SimpleNamespace(figures=(rotor, link), held=(Held(link, 9.9, ((rotor, 0.25),)),))
    truth = identification.combined(found, {"rotor_inertia:a": 1.2, "link_inertia:a": 0.6})
    np.testing.assert_allclose(truth, [1.2 + 0.25 * (0.6 - 1.0), 0.6])
