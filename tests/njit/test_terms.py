"""Rewards and terminations as `@njit` functions act as the same terms traced.

Their bits are equal here, because no sum has a rounded product: kernels fuse multiplications and additions.
"""

from __future__ import annotations

import copy
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest

import ce_gym
from ce_gym.envs.runtime.batch import TaskBatch
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.tasks import VELOCITY
from ce_gym.envs.terms import registry
from ce_gym.sim.devices import Cpu

numba = pytest.importorskip("numba")

from ce_gym.numba import reward, termination  # noqa: E402

ID = "ce_gym/MiniCheetahVelocity-Armature-v0"
USED = {
    "rewards": dict.fromkeys(VELOCITY.rewards, 0.0) | {"drift": {"weight": 0.5, "share": 0.25}, "alive": 0.2},
    "terminations": ["torso_contact", "low"],
    "contact_forces": True,
}


@pytest.fixture(autouse=True)
def registry_as_before(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(registry, "_added", {kind: dict(terms) for kind, terms in registry._added.items()})


def add_njit_terms(bad: float = 0.0):
    """Add the terms `drift` and `low`; `drift` returns `bad` where that is not 0."""

    @reward
    @numba.njit
    def drift(q, v, action, previous_action, foot_velocities, contact_forces, rotor_velocities, share=1.0):
        if bad != 0.0 and action[0] < 2.0:
            if bad < 0.0:
                raise ValueError("a mistake of the user")
            return bad
        steps = (foot_velocities[0, 2] > 0.1) + 2.0 * (rotor_velocities[3] > 1.0)
        return share * (abs(action[1] - previous_action[2]) + contact_forces[2, 1] + v[3] - q[2] + steps)

    @termination
    def low(base_height, height=0.24):
        return base_height[0] < height


def add_traced_terms():
    @ce_gym.reward
    def drift(s, share=1.0):
        steps = (s.foot_velocities[0, 2] > 0.1) + 2.0 * (s.rotor_velocities[3] > 1.0)
        return share * (abs(s.action[1] - s.previous_action[2]) + s.contact_forces[2, 1] + s.v[3] - s.q[2] + steps)

    @ce_gym.termination
    def low(s, height=0.24):
        return s.base_height < height


def results(make, n: int, steps: int = 40, **options) -> list:
    """Everything that steps return; `make` is `gymnasium.make_vec` or `make`."""
    env = make(ID, **options, **USED)
    kept, rng = [env.reset(seed=3)[0]], np.random.default_rng(0)
    for _ in range(steps):
        action = rng.uniform(-1, 1, (n, 12)).astype(np.float32)
        *result, info = env.step(action if make is gymnasium.make_vec else action[0])
        kept += [*result, info]
        if make is gymnasium.make and (result[2] or result[3]):
            kept.append(env.reset()[0])
    return kept


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_bits(mode):
    options = {"num_envs": 21, "num_threads": 2, "autoreset_mode": mode}
    add_njit_terms()
    called = results(gymnasium.make_vec, 21, **options)
    single = results(gymnasium.make, 21)
    add_traced_terms()
    assert sum(map(np.sum, called[3::5])) > 5  # robots that `low` terminated
    assert called[5]["reward_terms"]["drift"].std() > 0
    np.testing.assert_equal(called, results(gymnasium.make_vec, 21, **options))
    np.testing.assert_equal(single, results(gymnasium.make, 21))


def test_copies_and_single_precision():
    add_njit_terms()
    kept = {dtype: results(gymnasium.make_vec, 3, 5, num_envs=3, dtype=dtype) for dtype in ("float64", "float32")}
    np.testing.assert_allclose(kept["float64"][2], kept["float32"][2], rtol=1e-3)
    env: Any = gymnasium.make(ID, **USED).unwrapped
    env.reset(seed=0)
    again = copy.deepcopy(env)
    np.testing.assert_equal(env.step(np.zeros(12)), again.step(np.zeros(12)))
    assert env.symmetry is None
    assert [block["name"] for block in env.policy_spec()["observation"]["blocks"]][-1] == "last_action"
    with pytest.raises(ValueError, match="termination_low is an @njit function; expected"):
        env.look(env.state())
    with pytest.raises(ValueError, match=r"with terms that are @njit functions; expected traced terms"):
        env.differentiable()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_values_that_are_not_finite(bad, monkeypatch):
    printed = []
    monkeypatch.setattr(sys, "unraisablehook", lambda error: printed.append(str(error.exc_value)))
    add_njit_terms(bad)
    with pytest.raises(ValueError, match=r"reward term 'drift': (nan|inf) for robot 0; expected a finite number"):
        results(gymnasium.make_vec, 2, num_envs=2)
    assert printed == ["a mistake of the user"] * (bad == -1.0)


def parallel(q):
    return q[0]


@pytest.mark.parametrize(
    ("add", "message"),
    [
        (lambda: reward("q[2]"), r"reward term 'q\[2\]'; expected a function"),
        (lambda: reward(lambda width=1.0: width), r"arguments \(width=1.0\); expected names of properties"),
        (lambda: reward(lambda *q: 1.0), r"arguments \(\*q\)"),
        (lambda: reward(numba.njit(parallel=True)(parallel)), "parallel=True; expected @njit without it"),
        (lambda: ce_gym.reward(numba.njit(parallel)), "an @njit function; expected CasADi operations"),
    ],
)
def test_functions_that_cannot_be_terms(add, message):
    with pytest.raises(ValueError, match=message):
        add()


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda speed: 1.0, "no attribute 'speed' of TermContext"),
        (lambda kinematics: 1.0, "argument 'kinematics': Kinematics; expected a property with numbers"),
        (lambda contact_forces: 1.0, "contact_forces is not computed; expected contact_forces=True"),
        (lambda motor_torque: 1.0, "motor_torque is not computed; expected the observation 'motor_torques'"),
        (lambda q: q, r"returns array\(float64, 1d, C\); expected one float"),
        (lambda q: 1j * q[0], "returns complex128; expected one float"),
        (lambda q, name="FL": q[0], "name='FL'; expected a number or a list of numbers"),
        (lambda q: q[0] if q[1] > 0 else None, "returns OptionalType"),
        (lambda q: q.speed, "Unknown attribute 'speed' of type array"),
    ],
)
def test_rewards_that_cannot_be_called(function, message):
    function.__name__ = "mine"
    reward(function)
    with pytest.raises(ValueError, match=f"^reward term 'mine':? .*{message}.*$"):
        gymnasium.make(ID, rewards={"mine": 1.0})


def test_where_terms_cannot_be_called():
    termination(parallel)
    with pytest.raises(ValueError, match=r"termination term 'parallel' returns float64; expected one bool"):
        gymnasium.make(ID, terminations=["parallel"])
    add_njit_terms()

    class Gpu(Cpu):
        name, fuses = "cuda:0", True

    program = make_program("mini_cheetah", "velocity", transmission="none", **USED)
    with pytest.raises(ValueError, match=r"'drift': an @njit function on device 'cuda:0'; expected device='cpu'"):
        TaskBatch(program, 2, "float64", Gpu())
