"""Examples of controllers run, are as short as promised, and do what their page says."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ce_gym

FOLDER = Path(__file__).parents[2] / "docs" / "examples"


def example(name: str) -> dict[str, Any]:
    return runpy.run_path(str(FOLDER / f"{name}.py"))


def test_examples_are_short():
    assert all(len(file.read_text(encoding="utf-8").splitlines()) <= 80 for file in FOLDER.glob("*.py"))


@pytest.mark.slow
def test_whole_body_control():
    """The foot draws its circle, and the trunk stays at its height, above three feet that do not move."""
    pytest.importorskip("scipy")
    script = example("whole_body_control")
    errors, heights = script["main"](2.5)
    assert np.abs(errors[1500:]).max() < 1e-3
    assert np.abs(heights - script["model"].standing_q[2]).max() < 2e-3


@pytest.mark.slow
def test_torques_of_the_whole_body_controller():
    """Torques, desired acceleration and forces on the feet meet the equations of motion; forces lie in the pyramids."""
    pytest.importorskip("scipy")
    script, rng = example("whole_body_control"), np.random.default_rng(0)
    model, feet = script["model"], script["FEET"]
    q = model.integrate(model.standing_q, 0.003 * rng.normal(size=model.nv))
    v = 0.01 * rng.normal(size=model.nv)
    J_feet = model.contact_jacobian(q, feet)
    J = np.vstack([model.center_of_mass_jacobian(q), model.frame_jacobian(q, "Floating Base")[:3], *J_feet])
    vdot = script["desired_acceleration"](0.0, q, v, J)
    tau = np.concatenate([np.zeros(6), script["control"](0.0, q, v)])
    of_feet = model.mass_matrix(q) @ vdot + model.bias_force(q, v) - tau
    forces = np.linalg.lstsq(J[6:].T, of_feet, rcond=None)[0].reshape(4, 3)
    np.testing.assert_allclose(J[6:].T @ forces.ravel(), of_feet, rtol=0, atol=0.01)
    assert (np.abs(forces[:, :2]) <= script["FRICTION"] * forces[:, 2:] + 0.01).all()


@pytest.mark.slow
def test_mppi():
    pytest.importorskip("numba")
    heights, upright = example("mppi")["main"]()
    assert heights[0] < 0.18
    assert abs(heights[-20:].mean() - 0.3) < 0.03
    assert upright > 0.95


@pytest.mark.slow
def test_kalman_filter():
    numba = pytest.importorskip("numba")
    pytest.importorskip("scipy")
    num_threads = numba.get_num_threads()
    numba.set_num_threads(1)  # on a busy machine, threads wait for each other in each of 500 calls
    errors = example("kalman_filter")["main"](n=16)
    numba.set_num_threads(num_threads)
    angle, speed = errors[-100:].mean((0, 2))
    assert np.degrees(errors[0, 0].mean()) > 8
    assert np.degrees(angle) < 0.3
    assert speed < 0.03


@pytest.mark.parametrize(("robot", "foot"), [("mini_cheetah", "FL_foot"), ("cassie", "right_heel")])
def test_inverse_kinematics(robot: str, foot: str):
    """Positions of feet of a quadruped, and of a leg with closed loops."""
    model, rng = ce_gym.Model(robot), np.random.default_rng(0)
    q, v = np.tile(model.standing_q, (20, 1)), np.zeros((20, model.nv))
    points = model.frame_pose(q, foot)[0] + rng.uniform(-0.04, 0.04, (20, 3))
    solution = example("inverse_kinematics")["inverse_kinematics"](model, q, foot, points)
    reached = model.contact_points(solution, v)[0][:, model.contact_names.index(foot)]
    np.testing.assert_allclose(reached, points, rtol=0, atol=1e-9)
    assert np.array_equal(solution[:, :7], q[:, :7])
