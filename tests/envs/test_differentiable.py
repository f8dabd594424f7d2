"""Gradients of control steps against central differences, and what passes nothing on."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym  # noqa: F401  (registers the environments)
from ce_gym.envs.differentiable import DifferentiableEnv
from ce_gym.envs.runtime.gradient import ControlStepGradient
from ce_gym.envs.runtime.setup import make_program

N, STEPS = 16, 3
ACTIONS, SEEN = 2, 18
GRID = 2.0**-12
"""Actions are float32; those on a grid can be moved by exactly as much."""


def make(mode: str = "SameStep", **arguments):
    return gymnasium.make_vec(
        "ce_gym/MiniCheetahVelocity-v0", robot=TRIPOD, num_envs=N, autoreset_mode=mode, **arguments
    ).unwrapped


@pytest.fixture(scope="module")
def env():
    """Robots that stand, slide and fly, some time after a start."""
    env = make()
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(8):
        env.step(rng.uniform(-0.5, 0.5, (N, ACTIONS)).astype(np.float32))
    return env


class Objective:
    """A weighted sum of the observations, not rounded, and of the rewards of some control steps."""

    def __init__(self, env) -> None:
        rng = np.random.default_rng(1)
        self.env, self.start, self.look = env, env.snapshot(), env.batch.program.stages.observation_function()
        self.actions = np.round(rng.uniform(-0.5, 0.5, (STEPS, N, ACTIONS)) / GRID) * GRID
        self.by_observation, self.by_reward = rng.normal(size=(STEPS, N, SEEN)), rng.normal(size=(STEPS, N))

    def observed(self) -> np.ndarray:
        rows = [self.env.batch.rows(name) for name in self.look.name_in()]
        blocks = [np.array([self.look(*one)[i] for one in zip(*rows, strict=True)]) for i in range(7)]
        return np.concatenate([block.reshape(N, -1) for block in blocks], axis=1)

    def __call__(self, actions: np.ndarray, start=None) -> np.ndarray:
        self.env.restore(start or self.start)
        total = np.zeros(N)
        for action, by_observation, by_reward in zip(actions, self.by_observation, self.by_reward, strict=True):
            _, reward, *_ = self.env.step(action.astype(np.float32))
            total += (by_observation * self.observed()).sum(1) + by_reward * reward
        return total

    def gradient(self) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
        self.env.restore(self.start)
        differentiable = self.env.differentiable()
        for action in self.actions:
            differentiable.step(action)
        given = zip(self.by_observation[::-1], self.by_reward[::-1], strict=True)
        found = [differentiable.backward(*weights) for weights in given]
        return found[::-1], differentiable.state_gradient()


def compare(found: np.ndarray, scale: np.ndarray, difference) -> None:
    """Compare with fourth-order central differences, where no decision changes: where they agree with second order."""
    near, far = difference(1.0), difference(2.0)
    theirs, smooth = (4 * near - far) / 3, (np.abs(near - far) < 1e-4 * scale) & (scale > 0)
    assert smooth.sum() >= 0.6 * N
    assert (np.abs(found - theirs)[smooth] / scale[smooth]).max() < 1e-6


def test_gradient_to_actions(env):
    objective = Objective(env)
    gradient, _ = objective.gradient()
    for t, j in ((0, 0), (0, 1), (1, 1), (2, 0)):

        def difference(size: float, t=t, j=j) -> np.ndarray:
            change = np.zeros_like(objective.actions)
            change[t, :, j] = size * GRID
            return (objective(objective.actions + change) - objective(objective.actions - change)) / (2 * size * GRID)

        compare(gradient[t][:, j], np.abs(gradient[t]).max(1), difference)


def test_gradient_to_the_first_state(env):
    objective = Objective(env)
    _, state = objective.gradient()
    for name, column, size in (("v", 1, 1e-6), ("v", 5, 1e-6), ("v", 7, 1e-5), ("action", 1, 1e-4), ("q", 7, 1e-6)):

        def difference(share: float, name=name, column=column, size=size) -> np.ndarray:
            totals = []
            for sign in (1, -1):
                start = {key: value.copy() for key, value in objective.start.items()}
                start[name][:, column + (name == "q")] += sign * share * size  # a tangent lacks a number of the base
                totals.append(objective(objective.actions, start))
            return (totals[0] - totals[1]) / (2 * share * size)

        compare(state[name][:, column], np.abs(state[name]).max(1), difference)


def test_an_episode_that_ends_passes_nothing_on(env):
    differentiable = env.differentiable()
    env.reset(seed=0)
    env.elapsed_steps = np.where(np.arange(N) < 4, env.max_episode_steps - 2, 0)
    for _ in range(4):
        differentiable.step(np.zeros((N, ACTIONS)))  # time is up for the first four with the second
    by = [differentiable.backward(np.ones((N, SEEN))) for _ in range(2)]
    assert all(rows.any(axis=1).all() for rows in by)
    second = differentiable.backward(by_observation=np.ones((N, SEEN)))
    assert not second[:4].any()
    assert second[4:].any(axis=1).all()
    assert not differentiable.backward()[:4].any()
    for _ in range(2):
        env.elapsed_steps = np.where(np.arange(N) < 4, env.max_episode_steps - 1, 0)
        differentiable.step(np.zeros((N, ACTIONS)))
    final = differentiable.backward(by_final_observation=np.ones((N, SEEN)))
    assert final[:4].any(axis=1).all()
    assert not final[4:].any()


@pytest.mark.parametrize("change", ["restore", "step", "reset of some", "command"])
def test_gradients_stop_where_the_state_was_set(change: str):
    """The clock goes on as if nothing had happened; a command alone is no part of the motion."""
    env = make("Disabled")
    env.reset(seed=1)
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (4, N, ACTIONS)).astype(np.float32)
    env.step(actions[0])
    env.step(actions[1])
    kept = env.snapshot()
    env.reset(seed=2)
    differentiable, some = env.differentiable(), np.arange(N) < 4
    differentiable.step(actions[2])
    if change == "step":
        env.step(actions[3])
    else:
        differentiable.step(actions[3])
    if change == "restore":
        env.restore(kept)
    elif change == "reset of some":
        env.reset(options={"reset_mask": some})
    elif change == "command":
        env.set_command(np.zeros(3))
    differentiable.step(actions[0])
    assert differentiable.backward(by_reward=np.ones(N)).any(axis=1).all()
    rows = differentiable.backward().any(axis=1)
    cut = {"reset of some": some, "command": np.zeros(N, bool)}.get(change, np.ones(N, bool))
    np.testing.assert_array_equal(rows, ~cut)


def test_a_reset_in_the_next_step_ignores_its_action():
    env = make("NextStep")
    differentiable = env.differentiable()
    env.reset(seed=0)
    env.elapsed_steps = np.where(np.arange(N) < 4, env.max_episode_steps - 1, 0)
    for _ in range(3):
        differentiable.step(np.zeros((N, ACTIONS)))
    after, ignored, before = (differentiable.backward(np.ones((N, SEEN)), np.ones(N)) for _ in range(3))
    assert after.any(axis=1).all()
    assert not ignored[:4].any()
    assert ignored[4:].any(axis=1).all()
    assert before.any(axis=1).all()


def test_a_diverged_robot_has_no_gradient(env):
    differentiable = env.differentiable()
    env.reset(seed=0)
    differentiable.step(np.zeros((N, ACTIONS)))
    env.batch.write("v", 1e5, np.arange(N) == 2)
    assert differentiable.step(np.zeros((N, ACTIONS)))[4]["diverged"].nonzero()[0].tolist() == [2]
    ones = np.ones((N, SEEN))
    for _ in range(2):
        found = differentiable.backward(ones, np.ones(N), ones)
        assert np.isfinite(found).all()
    assert found[np.arange(N) != 2].any(axis=1).all()
    env.batch.write("v", 0.0)


def test_a_step_in_parts_has_no_gradient_though_a_reset_followed(env):
    """One robot of those whose time is up is too fast for its sub-step, and a new one in its place when it is seen."""
    differentiable, ones = env.differentiable(), np.ones((N, SEEN))
    env.reset(seed=0)
    env.elapsed_steps = np.where(np.arange(N) < 4, env.max_episode_steps - 1, 0)
    v = env.batch.rows("v")
    v[2, 7] = 500.0  # rad/s, of the forearm, more than half a radian in a sub-step
    env.batch.write("v", v)
    *_, truncated, infos = differentiable.step(np.zeros((N, ACTIONS)))
    assert truncated[:4].all()
    assert not infos["diverged"].any()
    differentiable.backward(ones, np.ones(N), ones)
    to_speed = differentiable.state_gradient()["v"].any(axis=1)
    assert to_speed.tolist() == [i != 2 for i in range(N)]


def test_carried_gradients_are_shortened(env):
    gradients = {}
    for largest in (np.inf, 1e-3):
        env.reset(seed=0)
        differentiable = env.differentiable(largest)
        for _ in range(2):
            differentiable.step(np.zeros((N, ACTIONS)))
        differentiable.backward(np.ones((N, SEEN)))
        owed = np.concatenate(list(differentiable.state_gradient().values()), axis=1)
        gradients[largest] = differentiable.backward(), np.linalg.norm(owed, axis=1)
    (free, length), (short, _) = gradients.values()
    np.testing.assert_allclose(short, free * 1e-3 / length[:, None], rtol=1e-9)


def test_terms_that_are_not_smooth_are_named(env):
    assert env.differentiable().not_smooth == {
        "reward feet_air_time": "no gradient",
        "reward stand_still": "kinks",
        "reward knee_contact": "no gradient",
        "termination torso_contact": "no gradient",
        "termination tilt": "no gradient",
    }


def test_what_cannot_be_differentiated_is_said(env):
    for arguments, message in (
        ({"terrain": "slope"}, "with terrain 'slope'; expected 'flat'"),
        ({"latency": [0, 2]}, r"with latency=\(0, 2\); expected \(0, 0\)"),
    ):
        with pytest.raises(ValueError, match=message):
            ControlStepGradient(make_program(TRIPOD, "velocity", **arguments))
    gpu = SimpleNamespace(batch=SimpleNamespace(place=SimpleNamespace(name="cuda"), num_envs=1, dtype="float32"))
    with pytest.raises(ValueError, match="on device 'cuda'; expected 'cpu'"):
        DifferentiableEnv(gpu)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="largest=0; expected a number above 0"):
        env.differentiable(0)
    differentiable = env.differentiable()
    with pytest.raises(ValueError, match="no control step is recorded"):
        differentiable.backward()
    differentiable.step(np.zeros((N, ACTIONS)))
    with pytest.raises(ValueError, match=r"gradient of observation 'policy' has shape \(3,\)"):
        differentiable.backward(np.zeros(3))
