"""Clusters whose transmissions stretch: elimination from the last coordinate on, and its cost."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.recursion.stretched import Stretched
from ce_gym.dynamics.stepping.trace import iteration_function
from ce_gym.sim import Simulator


@pytest.mark.parametrize("d", [2, 3, 4])
def test_elimination_solves_for_accelerations_and_what_is_felt(d: int):
    rng = np.random.default_rng(d)
    root, slope = rng.normal(size=(d, d)), np.diag(rng.uniform(0, 1, d))
    inertia, felt = root @ root.T + np.eye(d), rng.normal(size=(6, 6))
    biased, tau, a, force = rng.normal(size=(d, 7)), rng.normal(size=d), rng.normal(size=6), rng.normal(size=6)
    one = Stretched.of(*map(ca.SX, (inertia, slope, biased, tau)))
    U, u, D = biased[:, :6].T, biased[:, 6] + tau, inertia + slope
    np.testing.assert_allclose(np.array(ca.evalf(one.acceleration(ca.SX(a))))[:, 0], np.linalg.solve(D, u - U.T @ a))
    felt = felt + felt.T
    less, more = one.articulated(ca.SX(felt), ca.SX(force))
    np.testing.assert_allclose(np.array(ca.evalf(less)), felt - U @ np.linalg.solve(D, U.T))
    np.testing.assert_allclose(np.array(ca.evalf(more))[:, 0], force + U @ np.linalg.solve(D, u))


@pytest.mark.slow
def test_where_links_may_touch_motion_is_the_same():
    """With pairs of links, clusters are solved in the other order, because pair forces are not known before."""
    model, dt = Model("mini_cheetah", "elastic"), 0.005
    first, standing = model.robot.layout.joints_q, model.standing_q
    targets = standing[first : first + len(model.joint_links)] + np.random.default_rng(0).uniform(-0.2, 0.2, (4, 12))
    moved = []
    for pairs in ((), (("FL_knee_link", "FR_knee_link"),)):
        sim = Simulator(model, 4, dt=dt, contacts="foot", self_collisions=pairs)
        sim.step(targets, n_substeps=20)
        moved.append(sim.v.copy())
    np.testing.assert_allclose(*moved, atol=1e-9)
    assert np.abs(moved[0]).max() > 1.0


def test_an_iteration_costs_at_most_a_fifth_more_than_at_exact():
    """Instruction counts are deterministic; twelve drives with backlash on four feet."""
    robot = Model("mini_cheetah").robot
    options = StepOptions(contacts=tuple(c.name for c in robot.contacts if c.group == "foot"), dt=None)
    exact, stretching = (
        iteration_function(Model(robot, level).mechanism, options).n_instructions() for level in ("exact", "elastic")
    )
    assert stretching <= 1.18 * exact
