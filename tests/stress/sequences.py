"""Calls in any order on a batch of robots, beside some of the robots in batches of their own: the states are the same.

Steps, resets and states of some robots, divergence, refused calls, snapshots, copies. Calls on one robot do not affect
the others; nothing but NaN at the input of a refused call is ever not finite.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator

N = 9
"""Robots of a batch: one more than fill a vector register in double precision."""
WATCHED = (0, 7, 8)
"""Those that have a batch of their own, too."""
TOO_FAST = 2e4
"""A speed at which a robot has diverged [rad/s or m/s]."""


class Beside:
    """A batch of robots and those that are watched by themselves; each operation is done to both.

    Args:
        batch: All robots.
        alone: Batches of one robot, by the place in the large one.
    """

    OF_CALLS: tuple[str, ...] = ()
    """What is kept of the last call on all robots, whomever it concerned."""
    READ: tuple[str, ...] = ("q", "v", "load", "anchor")
    """Rows of a snapshot that a step reads."""

    def __init__(self, batch: Any, alone: dict[int, Any]) -> None:
        self.batch, self.alone = batch, alone
        self.kept = [self.saved()]

    def begin(self) -> None:
        """Go back to where all began."""
        del self.kept[1:]
        self.restore(np.random.default_rng(0))

    def saved(self) -> tuple[Any, dict[int, Any]]:
        """Return snapshots."""
        return self.batch.snapshot(), {i: one.snapshot() for i, one in self.alone.items()}

    def keep(self, rng: np.random.Generator) -> None:
        """Take snapshots, for later."""
        self.kept.append(self.saved())

    def restore(self, rng: np.random.Generator) -> None:
        """Go back to some snapshots."""
        whole, parts = self.kept[rng.integers(len(self.kept))]
        self.batch.restore(whole)
        for i, part in parts.items():
            self.alone[i].restore(part)
        for name, array in self.batch.snapshot().items():
            np.testing.assert_array_equal(array, whole[name], err_msg=f"restored {name}")

    def copied(self, rng: np.random.Generator) -> None:
        """Go on with a copy."""
        self.batch = copy.deepcopy(self.batch) if rng.random() < 0.5 else pickle.loads(pickle.dumps(self.batch))

    def damaged(self, rng: np.random.Generator) -> None:
        """Restore snapshots with a number, a name or a shape that is wrong: all are refused, and nothing changes."""
        state = {name: array.copy() for name, array in self.batch.snapshot().items()}
        name = str(rng.choice(self.READ))
        damage = rng.integers(4)
        if damage == 0:
            state[name].reshape(-1)[rng.integers(state[name].size)] = rng.choice([np.nan, -np.inf])
        elif damage == 1:
            state["failures"][rng.integers(N)] = -1
        elif damage == 2:
            state[name] = state[name][:-1] if rng.random() < 0.5 else state[name].astype("f2")
        else:
            state[f"{name}_"] = state.pop(name)
        expect_refusal(lambda: self.batch.restore(state))

    def some(self, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Choose robots, at least one."""
        chosen = rng.random(N) < 0.4
        chosen[rng.integers(N)] = True
        return chosen

    def check(self) -> None:
        """Compare all that is kept of the robots."""
        whole, parts = self.saved()
        for name, array in whole.items():
            for i, part in parts.items():
                if np.shape(array)[:1] == (N,) and name not in self.OF_CALLS:
                    np.testing.assert_array_equal(array[i], part[name][0], err_msg=name)


class Simulators(Beside):
    """Robots without a task."""

    OPERATIONS = ("step", "reset", "place", "diverge", "keep", "restore", "copied", "refused", "damaged")

    def __init__(self, robot: str) -> None:
        self.model = Model(robot)
        super().__init__(Simulator(self.model, N), {i: Simulator(self.model, 1) for i in WATCHED})

    def step(self, rng: np.random.Generator) -> None:
        """Step with targets of each robot's own."""
        joints = self.model.standing_q[self.model.robot.layout.joints_q :]
        targets, n = joints + rng.normal(0, 0.3, (N, len(joints))), int(rng.integers(4))
        self.batch.step(targets, n)
        for i, one in self.alone.items():
            one.step(targets[i], n)

    def reset(self, rng: np.random.Generator) -> None:
        """Put some back."""
        chosen = self.some(rng)
        self.batch.reset(chosen)
        for i in filter(chosen.__getitem__, WATCHED):
            self.alone[i].reset()

    def place(self, rng: np.random.Generator, speed: float = 1.0) -> None:
        """Set the states of some."""
        chosen, v = self.some(rng), speed * rng.normal(1.0, 0.1, (N, self.model.nv))
        q = np.tile(self.model.standing_q, (N, 1))
        q[:, self.model.robot.layout.joints_q :] += rng.uniform(-0.05, 0.05, (N, len(self.model.robot.independent)))
        self.batch.set_state(q, v, chosen)
        for i in filter(chosen.__getitem__, WATCHED):
            self.alone[i].set_state(q[i], v[i])

    def diverge(self, rng: np.random.Generator) -> None:
        """Make some so fast that a step flags them."""
        self.place(rng, TOO_FAST)

    def refused(self, rng: np.random.Generator) -> None:
        """Make calls that must be refused."""
        expect_refusal(lambda: self.batch.step(np.full(len(self.model.robot.independent), np.nan)))
        expect_refusal(lambda: self.batch.set_state(np.zeros(self.model.nq + 1), np.zeros(self.model.nv)))
        for mask in (np.arange(N), np.ones(N), np.full(N, np.nan), [None] * N, "all", np.ones(N + 1, bool)):
            expect_refusal(lambda mask=mask: self.batch.reset(mask))
        expect_refusal(lambda: self.batch.step(self.model.standing_q[self.model.robot.layout.joints_q :] + 0j))

    def check(self) -> None:
        """Compare, and look for numbers that are not finite."""
        super().check()
        assert all(np.isfinite(x).all() for x in (self.batch.q, self.batch.v, self.batch.torque))


class Environments(Beside):
    """Robots with a task, in a vector environment."""

    OPERATIONS = ("step", "reset", "diverge", "keep", "restore", "copied", "refused", "damaged", "close")
    OF_CALLS = ("chosen",)  # the mask of the last reset

    def __init__(self, robot: str, mode: str = "SameStep") -> None:
        self.options = {"robot": robot, "autoreset_mode": mode, "max_episode_steps": 5}
        batch, alone = self._made(N), {i: self._made(1) for i in WATCHED}
        batch.reset(seed=0)
        for i, one in alone.items():
            one.reset(seed=i)
        super().__init__(batch, alone)

    def _made(self, n: int) -> Any:
        return gymnasium.make_vec("ce_gym/MiniCheetahVelocity-v0", num_envs=n, **self.options).unwrapped

    def step(self, rng: np.random.Generator) -> None:
        """Act, also beyond the limits of actions."""
        actions = rng.normal(0, 1, self.batch.action_space.shape).astype(np.float32)
        together = self.batch.step(actions)[:4]
        for i, one in self.alone.items():
            for ours, theirs in zip(together, one.step(actions[i : i + 1])[:4], strict=True):
                np.testing.assert_array_equal(ours[i], theirs[0])
        assert all(np.isfinite(part).all() for part in together)

    def reset(self, rng: np.random.Generator) -> None:
        """Begin some episodes anew, seeded or not."""
        chosen, seed = self.some(rng), int(rng.integers(99)) if rng.random() < 0.5 else None
        self.batch.reset(seed=seed, options={"reset_mask": chosen})
        for i in filter(chosen.__getitem__, WATCHED):
            self.alone[i].reset(seed=None if seed is None else seed + i)

    def diverge(self, rng: np.random.Generator) -> None:
        """Spoil the velocities of some."""
        chosen = self.some(rng)
        for envs, rows in ((self.batch, chosen), *((one, chosen[i : i + 1]) for i, one in self.alone.items())):
            v = envs.batch.rows("v")
            v[rows, -1] = 1e9
            envs.batch.write("v", v)

    def refused(self, rng: np.random.Generator) -> None:
        """Make calls that must be refused."""
        expect_refusal(lambda: self.batch.step(np.full(self.batch.action_space.shape, np.nan)))
        expect_refusal(lambda: self.batch.reset(options={"reset_mask": np.ones(N + 1, bool)}))
        for steps in (np.nan, np.inf, -5, 0.5, "0", np.zeros(N + 1)):
            expect_refusal(lambda steps=steps: setattr(self.batch, "elapsed_steps", steps))

    def close(self, rng: np.random.Generator) -> None:
        """Close the batch, which then refuses to step, and go on with another one in the same state."""
        state, old = self.batch.snapshot(), self.batch
        old.close()
        expect_refusal(lambda: old.step(np.zeros(old.action_space.shape, np.float32)))
        self.batch = self._made(N)
        self.batch.restore(state)


def expect_refusal(call: Any) -> None:
    """Check that a call raises, in one line.

    Raises:
        AssertionError: If it does not.
    """
    try:
        call()
    except (ValueError, gymnasium.error.Error, gymnasium.error.ClosedEnvironmentError) as error:
        if "\n" in str(error):
            raise AssertionError(f"several lines: {error}") from error
    else:
        raise AssertionError("a wrong call was not refused")


def carry_out(beside: Beside, calls: Sequence[tuple[str, int]]) -> None:
    """Carry out operations by name from the beginning, each with a seed, and compare after each.

    Raises:
        AssertionError: If a robot of the batch differs from the robot alone.
    """
    beside.begin()
    for name, seed in calls:
        getattr(beside, name)(np.random.default_rng(seed))
        beside.check()
