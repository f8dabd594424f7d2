"""Iterative LQR: its plan is stationary, its feedback helps, and a jump of a small robot is planned and shown."""

import json

import ilqr
import jump
import numpy as np
import pytest
from ilqr import ILQR, difference
from tripod import TRIPOD

import ce_gym
from ce_gym.viewer import Rollout

LEG = ce_gym.Model("planar_leg_linkage")


class Reach:
    """A leg that is to be at rest in another pose at the end."""

    target_slope = 0.3

    def __init__(self, end: int) -> None:
        self.end, self.goal = end, LEG.standing_q + [0.2, -0.3]

    def weights(self, i: int) -> np.ndarray:
        return np.array([5.0, 3.0, 0.2, 0.1]) if i == self.end else np.full(4, 0.02)

    def residuals(self, i: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return self.weights(i) * np.hstack([q - self.goal, v])

    def slopes(self, i: int, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.diag(self.weights(i))

    def target_residuals(self, i: int, targets: np.ndarray) -> np.ndarray:
        return self.target_slope * (targets - LEG.standing_q)


@pytest.fixture(scope="module")
def reached():
    start = {"q": LEG.standing_q[None], "v": np.zeros((1, 2))}
    solver = ILQR(lambda n: ce_gym.Simulator(LEG, n), Reach(10), start, hold=2)
    plan = solver.first(np.tile(LEG.standing_q, (10, 1)))
    for _ in range(20):
        plan = solver.improved(plan) or plan
    return solver, solver.with_feedback(plan)


def test_a_plan_is_stationary_by_the_reverse_mode(reached):
    """The gradient of its cost by all targets, found by going back through the steps, is next to nothing."""
    solver, plan = reached

    def gradient(targets: np.ndarray) -> np.ndarray:
        robot = ce_gym.StepDerivatives(ce_gym.Simulator(LEG, 1))
        robot.restore(solver.start)
        owed, records, cost = [], [], solver.cost
        for i, target in enumerate(targets):
            state = robot.state()
            owed.append(cost.slopes(i, *state.values()).T @ cost.residuals(i, *state.values())[0])
            robot.step(target, solver.hold)
            records.append(robot.take())
        state, found = robot.state(), np.zeros_like(targets)
        carried = cost.slopes(10, *state.values()).T @ cost.residuals(10, *state.values())[0]
        for i in reversed(range(len(targets))):
            before, by_target, _ = robot.backward({"q": carried[None, :2], "v": carried[None, 2:]}, records[i])
            carried = np.hstack([before["q"][0], before["v"][0]]) + owed[i]
            found[i] = np.sum(by_target, axis=0)[0] + cost.target_slope * cost.target_residuals(i, targets[i])
        return found

    first = np.abs(gradient(np.tile(LEG.standing_q, (10, 1)))).max()
    assert first > 0.1
    assert np.abs(gradient(plan.targets)).max() < 1e-4 * first


def test_feedback_makes_up_for_another_start(reached):
    solver, plan = reached
    solver.start = {"q": LEG.standing_q + [[0.05, -0.1]], "v": np.array([[1.0, -1.0]])}
    lengths, none = np.zeros(len(ilqr.LENGTHS)), np.zeros_like(plan.targets)
    with_it, _ = solver.follow(plan, none, lengths, solver.candidates)
    without, _ = solver.follow(jump.replace(plan, gains=0 * plan.gains), none, lengths, solver.candidates)
    solver.start = {"q": LEG.standing_q[None], "v": np.zeros((1, 2))}
    assert with_it[0] < without[0]
    target = np.zeros_like(none) + [[0.02, 0.02]]
    further, _ = solver.follow(plan, target, lengths + 1e-3, solver.candidates)
    assert further[0] > plan.cost


def test_the_way_between_states_is_that_of_derivatives():
    """To first order, the base turned and moved in its own axes."""
    model, rng = ce_gym.Model(TRIPOD), np.random.default_rng(0)
    q = model.standing_q.copy()
    q[3:7] = rng.normal(size=4)
    q[3:7] /= np.linalg.norm(q[3:7])
    here = {"q": q, "v": np.zeros(model.nv), "load": np.zeros(3)}
    cost = jump.Jump(model, 0.2)
    slopes = cost.slopes(5, q[None], here["v"][None])
    for i in range(model.nv):
        turn, ahead = q.copy(), np.eye(model.nv)[i] * 1e-6
        turn[3:7] += 0.5 * np.array(
            [
                -q[4:7] @ ahead[:3],
                *(q[3] * ahead[:3] + np.cross(q[4:7], ahead[:3])),
            ]
        )
        w, u = q[3], q[4:7]
        turn[:3] += ahead[3:6] + 2 * np.cross(u, np.cross(u, ahead[3:6]) + w * ahead[3:6])
        turn[7:] += ahead[6:]
        there = {"q": turn[None], "v": np.zeros((1, model.nv)), "load": np.ones((1, 3))}
        way = difference(model, there, here)[0]
        np.testing.assert_allclose(way[: model.nv], ahead, rtol=0, atol=1e-11)
        assert (way[-3:] == 1).all()
        change = cost.residuals(5, turn[None], here["v"][None]) - cost.residuals(5, q[None], here["v"][None])
        np.testing.assert_allclose(slopes[:, i] * 1e-6, change[0], rtol=0, atol=1e-10)


def test_a_jump_is_planned_and_shown(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(jump, "HORIZONS", (0.02, 0.04))
    monkeypatch.setattr(jump, "MOST", 2)
    monkeypatch.setattr(
        jump.Jumper, "simulator", lambda self, n: ce_gym.Simulator(self.model, n, contacts="foot", outputs=())
    )
    shown = list[Rollout]()
    monkeypatch.setattr(jump, "write_html", lambda rollouts, page, spacing: shown.extend(rollouts) or page)
    result = tmp_path / "jump.json"
    assert jump.main([TRIPOD, "--level", "exact", "--height", "0.05", "--json", str(result)]) == 0
    found = json.loads(result.read_text())
    planned, followed, alone = found["motions"][:3]
    assert planned["cost"] == followed["cost"] == alone["cost"]
    assert found["times"]["exact"]["iterations"] >= 1
    assert "| exact" in capsys.readouterr().out
    assert [len(rollout) for rollout in shown] == [9, 9]


def test_a_robot_that_cannot_jump_is_told_in_one_line(capsys):
    assert jump.main(["four_bar"]) == 2
    assert capsys.readouterr().err == "ce_gym: four_bar: its base cannot move; expected a robot with a floating base\n"
