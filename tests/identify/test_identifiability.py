"""Unidentifiable parameters of a linear problem, against an independent least-squares solution."""

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
    """Derivatives (100, 4) of which the first three are `apart` from each other, in order of sensitivity."""
    one, *others, last = np.linalg.qr(np.random.default_rng(3).normal(size=(100, 5)))[0].T
    return np.stack([*(one + apart * other for other in others), last], axis=1) * [100, 110, 200, 100]


def solve_linear(J: np.ndarray) -> tuple[list[Unidentifiable], np.ndarray, np.ndarray, dict[str, tuple[float, float]]]:
    """Unidentifiable parameters, indices of the rest, estimates of all without noise, and intervals of the rest."""
    planted = np.array([PLANTED[parameter.name] for parameter in PARAMETERS]) / SCALE
    free, x = select_identifiable(J, planted, PARAMETERS, 1.0)
    values = NOMINAL / SCALE
    fixed = np.setdiff1d(np.arange(4), free)
    seen = J @ planted - J[:, fixed] @ values[fixed]
    values[free] = np.linalg.solve(J[:, free].T @ J[:, free], J[:, free].T @ seen)
    np.testing.assert_allclose(x, values[free], rtol=1e-6)
    std = np.zeros(4)
    std[free] = np.sqrt(np.diag(np.linalg.inv(J[:, free].T @ J[:, free])))
    ends = zip(values * SCALE, 1.96 * std * SCALE, strict=True)
    intervals = {f.name: (v - s, v + s) for f, (v, s) in zip(PARAMETERS, ends, strict=True)}
    return find_unidentifiable(J, values, free, PARAMETERS, 1.0), free, values * SCALE, intervals


def test_of_three_similar_parameters_only_one_is_estimated():
    fixed, free, values, intervals = solve_linear(columns(1e-4))
    assert [item.parameter for item in fixed] == [A, B]
    assert free.tolist() == [2, 3]
    for item, slope in zip(fixed, (0.1, 0.11), strict=True):  # of felt 1, 1.1 and 2, and scales 1, 1 and 0.2
        assert item.shifted == ((C, pytest.approx(slope, rel=1e-3)),)
    lines, low_high = unidentifiable_warnings(fixed, intervals), "{:.5g} to {:.5g}".format(*intervals[C.name])
    for line in lines:
        assert f"{C.name} + 0.1 ({A.name} - 1) + 0.11 ({B.name} - 1) is {values[2]:.5g}, {low_high}" in line
        assert "the data cannot separate it from motor_friction:c;" in line
        assert "1 to 1" not in line
    assert lines[0].startswith("rotor_inertia:a is held at 1, as in the robot's file: ")


def test_an_independent_unidentifiable_parameter_shifts_nothing():
    J = columns(1.0) * [0.01, 1, 1, 1]
    J[:, 0] -= J[:, 1:] @ np.linalg.lstsq(J[:, 1:], J[:, 0], rcond=None)[0]
    fixed, _, _, intervals = solve_linear(J)
    share = np.sqrt(covariance_of(J, 1.0)[0, 0])
    assert [(item.parameter, item.shifted) for item in fixed] == [(A, ())]
    assert unidentifiable_warnings(fixed, intervals)[0].endswith(f"the data know it to {100 * share:.3g} % only")
