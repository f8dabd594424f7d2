"""Compiled steps of transmissions that stretch: against the same step in CasADi, batches, derivatives, precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym import Model, Simulator, StepDerivatives
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Elasticity, Robot, load_robot

N = 16


def elastic(stiffness: float = 20.0, **figures: float) -> Robot:
    """A floating robot of which every transmission gives way."""
    robot = load_robot(TRIPOD)
    return replace(robot, elastic=tuple(Elasticity(r.name, stiffness, **figures) for r in robot.rotors()))


def rattling() -> tuple[Simulator, np.ndarray]:
    """Robots that land, with play between their flanks, and their targets."""
    model, rng = Model(elastic(backlash=0.1, damping=0.002), "elastic"), np.random.default_rng(3)
    sim = Simulator(model, N, contacts="foot", outputs=("torque", "motor_speed", "energy"))
    n = len(model.joint_links)
    q = np.tile(model.standing_q, (N, 1))
    q[:, 7:] += rng.normal(0, 0.05, (N, model.nq - 7))
    sim.set_state(q, rng.normal(0, 0.5, (N, model.nv)))
    return sim, model.standing_q[7 : 7 + n] + rng.normal(0, 0.3, (N, n))


def test_kernels_make_the_step_that_is_traced():
    sim, target = rattling()
    assert sim.torque.shape == target.shape == (N, len(sim.target_names))
    step = step_function(sim.model.mechanism, replace(sim.options, dt=sim.dt))
    acted = set()
    for _ in range(10):
        names = [name for name in step.name_in() if name != "target"]
        before = {name: np.atleast_2d(sim._batch.rows(name)) for name in names}
        sim.step(target)
        for i in range(N):
            result = step(**{name: rows[i] for name, rows in before.items()}, target=target[i])
            np.testing.assert_allclose(sim.q[i], result["q_next"].full().ravel(), rtol=1e-9, atol=1e-12)
        acted |= set(np.sign(np.abs(sim.q[:, -1]) - 0.05))
    assert acted == {1.0, -1.0}, "between flanks and on one"
    assert not sim.diverged.any()


def test_gradients_go_through_meshes():
    """A and B of a step against central differences, flanks pressed and free."""
    sim, target = rattling()
    sim.step(target, 5)
    q, v, h = sim.q.copy(), sim.v.copy(), 1e-7
    keep = sim.snapshot()
    A, B = StepDerivatives(sim).linearize(target)

    def after(row: int, amount: float) -> np.ndarray:
        sim.restore(keep)
        moved = sim.v.copy()
        moved[:, row] += amount
        sim.restore({**sim.snapshot(), "v": moved})
        sim.step(target)
        return np.hstack([sim.q[:, 7:], sim.v])

    for row in range(6, sim.model.nv):
        found = np.hstack([A[:, 6 : sim.model.nv, sim.model.nv + row], A[:, sim.model.nv :, sim.model.nv + row]])
        expected = (after(row, h) - after(row, -h)) / (2 * h)
        close = np.abs(found - expected).max(axis=1) < 1e-4 * np.abs(expected).max()
        assert close.mean() > 0.9, "all but what lets go within the difference"
    assert np.isfinite(B).all()
    assert not np.array_equal(q, sim.q)
    assert v.shape == sim.v.shape


def test_single_precision_does_not_mind_stiffness():
    """The stretch is the coordinate, not a difference of large angles: 50 and 10^8 N m/rad."""
    model, ends = Model(elastic(50.0), "elastic"), {}
    n = len(model.joint_links)
    for dtype in ("float64", "float32"):
        sim = Simulator(model, 2, dtype=dtype, contacts="foot", parameters=("drive_stiffness",), outputs=())
        sim.set_parameter("drive_stiffness", [[1.0], [2e6]])
        sim.step(model.standing_q[7 : 7 + n] + 0.1, 20)
        ends[dtype] = sim.q[:, : 7 + n]
    np.testing.assert_allclose(ends["float32"], ends["float64"], atol=2e-5)


def test_play_that_differs_from_robot_to_robot():
    """Wider play lets a joint that is pulled at hang further back, by half of the play over the gear ratio."""
    model = Model(elastic(100.0, backlash=0.01, damping=0.05), "elastic")
    sim = Simulator(model, 3, contacts="foot", parameters=("backlash",), outputs=())
    sim.set_parameter("backlash", [[0.5], [1.0], [2.0]])
    for _ in range(10):
        sim.step(model.standing_q[7 : 7 + len(model.joint_links)], 40)
    free = np.abs(sim.q[:, 7 + len(model.joint_links) :]).max(axis=1)
    assert (np.diff(free) > 0).all()
    with pytest.raises(ValueError, match="expected 0 or more"):
        sim.set_parameter("backlash", -1.0)
