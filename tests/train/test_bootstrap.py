"""Interquartile means by hand, and bootstrap intervals against all resamples of a few runs and the normal law."""

import itertools

import numpy as np
import pytest
from bootstrap import difference, interquartile_mean, interval, of_one


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, -50.0])) == 1.5
    assert interquartile_mean(np.array([9.0, 1, 2, 3, 4, 5, 6, 7, 8, 0])) == 4.5  # two of ten at each end
    assert interquartile_mean(np.array([0.0, 0.0, 9.0])) == 3.0  # none of three
    lopsided = np.array([0.0, 0, 1, 2, 3, 6, 50, 90])
    assert interquartile_mean(lopsided) == 3.0
    np.testing.assert_array_equal(interquartile_mean(np.stack([lopsided, -lopsided])), [3.0, -3.0])


def test_an_interval_is_that_of_all_resamples():
    """Of four runs there are 256, so that percentiles of the distribution can be counted."""
    x = np.array([0.0, 1.0, 4.0, 10.0])
    every = np.sort([np.sort(drawn)[1:3].mean() for drawn in itertools.product(x, repeat=4)])
    found, low, high = interval(of_one, [x])
    assert found == 2.5
    assert (low, high) == pytest.approx((np.percentile(every, 2.5), np.percentile(every, 97.5)))


def test_the_interval_of_a_difference_resamples_each_arm_on_its_own():
    """Against the normal law: an interquartile mean of n normal values has a variance of about 1.2 / n."""
    rng = np.random.default_rng(1)
    n, spread = 400, (1.0, 2.0)
    a, b = (rng.normal(mean, width, n) for mean, width in zip((5.0, 3.0), spread, strict=True))
    found, low, high = interval(difference, [a, b])
    assert found == interquartile_mean(a) - interquartile_mean(b)
    half = 1.96 * np.sqrt(1.2 * (spread[0] ** 2 + spread[1] ** 2) / n)
    assert (high - low) / 2 == pytest.approx(half, rel=0.1)
    assert low < 2.0 < high


def test_a_single_run_has_no_interval():
    found, low, high = interval(difference, [np.array([3.0]), np.array([1.0, 2.0])])
    assert found == 1.5
    assert np.isnan([low, high]).all()


def test_intervals_cover_what_they_should():
    rng = np.random.default_rng(2)
    for n, least in ((10, 0.85), (40, 0.91)):
        ends = [interval(of_one, [x])[1:] for x in rng.normal(0.0, 1.0, (200, n))]
        covered = np.mean([low < 0.0 < high for low, high in ends])
        assert least < covered < 0.99, n
