"""What is held and what estimates then are, on columns of the test's own: a linear problem, solved without the code."""

import numpy as np
import pytest

from ce_gym.identify.identifiability import (
    Unidentifiable,
    covariance_of,
    find_unidentifiable,
    select_identifiable,
    unidentifiable_warnings,
)
from ce_gym.identify.parameters import Parameter

PARAMETERS = [
    Parameter("rotor_inertia", "a", 1.0, 1.0, 0.02, 50.0, 1.0, 0),
    Parameter("link_inertia", "b", 1.0, 1.0, 0.02, 50.0, 1.0, 0),
    Parameter("motor_friction", "c", 0.0, 0.1, 0.0, 50.0, 0.2, 0),
    Parameter("delay", "", 0.0, 0.003, 0.0, 0.03, 0.01, -1),
]
A, B, C, D = PARAMETERS
SCALE = np.array([parameter.scale for parameter in PARAMETERS])
NOMINAL = np.array([parameter.nominal for parameter in PARAMETERS])
PLANTED = {A.name: 1.3, B.name: 0.8, C.name: 0.15, D.name: 0.007}


def columns(apart: float) -> np.ndarray:
    """Derivatives (100, 4) of which the first three are `apart` from each other, and felt in this order."""
    one, *others, last = np.linalg.qr(np.random.default_rng(3).normal(size=(100, 5)))[0].T
    return np.stack([*(one + apart * other for other in others), last], axis=1) * [100, 110, 200, 100]


def found_in(J: np.ndarray) -> tuple[list[Unidentifiable], np.ndarray, np.ndarray, dict[str, tuple[float, float]]]:
    """What is held, places of the rest, estimates of all by least squares without noise, and intervals of the rest."""
    planted = np.array([PLANTED[parameter.name] for parameter in PARAMETERS]) / SCALE
    left, x = select_identifiable(J, planted, PARAMETERS, 1.0)
    values = NOMINAL / SCALE
    held = np.setdiff1d(np.arange(4), left)
    seen = J @ planted - J[:, held] @ values[held]
    values[left] = np.linalg.solve(J[:, left].T @ J[:, left], J[:, left].T @ seen)
    np.testing.assert_allclose(x, values[left], rtol=1e-6)
    std = np.zeros(4)
    std[left] = np.sqrt(np.diag(np.linalg.inv(J[:, left].T @ J[:, left])))
    ends = zip(values * SCALE, 1.96 * std * SCALE, strict=True)
    intervals = {f.name: (v - s, v + s) for f, (v, s) in zip(PARAMETERS, ends, strict=True)}
    return find_unidentifiable(J, values, left, PARAMETERS, 1.0), left, values * SCALE, intervals


def test_of_three_similar_parameters_only_one_is_estimated():
    held, left, values, intervals = found_in(columns(1e-4))
    assert [item.parameter for item in held] == [A, B]
    assert left.tolist() == [2, 3]
    for item, slope in zip(held, (0.1, 0.11), strict=True):  # of felt 1, 1.1 and 2, and scales 1, 1 and 0.2
        assert item.shifted == ((C, pytest.approx(slope, rel=1e-3)),)
    lines, low_high = unidentifiable_warnings(held, intervals), "{:.5g} to {:.5g}".format(*intervals[C.name])
    for line in lines:
        assert f"{C.name} + 0.1 ({A.name} - 1) + 0.11 ({B.name} - 1) is {values[2]:.5g}, {low_high}" in line
        assert "the data cannot separate it from motor_friction:c;" in line
        assert "1 to 1" not in line
    assert lines[0].startswith("rotor_inertia:a is held at 1, as in the robot's file: ")


def test_an_independent_unidentifiable_parameter_shifts_nothing():
    J = columns(1.0) * [0.01, 1, 1, 1]
    J[:, 0] -= J[:, 1:] @ np.linalg.lstsq(J[:, 1:], J[:, 0], rcond=None)[0]
    held, _, _, intervals = found_in(J)
    share = np.sqrt(covariance_of(J, 1.0)[0, 0])
    assert [(item.parameter, item.shifted) for item in held] == [(A, ())]
    assert unidentifiable_warnings(held, intervals)[0].endswith(f"the data know it to {100 * share:.3g} % only")
