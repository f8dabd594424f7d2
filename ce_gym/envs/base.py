"""Base class and helpers of single and vector environments."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from gymnasium.error import ClosedEnvironmentError
from gymnasium.spaces import Box, Dict
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from ce_gym.compile import CriticalSection
from ce_gym.envs.differentiable import DifferentiableEnv
from ce_gym.envs.policy_spec import policy_spec
from ce_gym.envs.rendering import Screen
from ce_gym.envs.runtime.batch import TaskBatch
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.stages import OBSERVATION_BOUND
from ce_gym.envs.runtime.symmetry import Symmetry, left_right
from ce_gym.model.arguments import check, check_choice
from ce_gym.sim.batch import File, Snapshot
from ce_gym.sim.devices import Array
from ce_gym.sim.inputs import finite_array, real_array


class BaseEnv(EzPickle):
    """Base class of the environments, which wrap a batch.

    Attributes:
        batch: The batch.
        task: Name of the task.
        model: The robot at a transmission level.
        closed: Whether `close` has been called.
    """

    closed = False

    def _attach(self, batch: TaskBatch, task: str, display: Mapping[str, Any]) -> None:
        """Set the batch, and the render and observation modes from the arguments `display`."""
        self.batch, self.task, self.model = batch, task, batch.program.model
        self.render_mode, self._as_dict = display["render_mode"], display["obs_mode"] == "dict"
        self._screen = Screen(self.render_mode, batch, width=display["width"], height=display["height"])
        self._section = CriticalSection(self._title)

    def __getstate__(self) -> dict[str, Any]:
        attributes = {name: self.__dict__.get(name) for name in ("spec", "_np_random", "_np_random_seed")}
        return {**EzPickle.__getstate__(self), "attributes": attributes, "state": self.snapshot()}

    def __setstate__(self, pickled: dict[str, Any]) -> None:
        self.__init__(*pickled["_ezpickle_args"], **pickled["_ezpickle_kwargs"])  # type: ignore[misc]
        self.__dict__.update(pickled["attributes"])
        self.restore(pickled["state"])

    def snapshot(self, file: File | None = None) -> Snapshot:
        """Return the full state of the robots, episodes and random streams; `restore` continues bit for bit.

        Args:
            file: Path of an `.npz` file to which the snapshot is also written.

        Returns:
            Arrays by name with one row for each robot, copied to the CPU. Wrappers such as Gymnasium's `TimeLimit` have
            further state.
        """
        return self.batch.snapshot(file)

    def restore(self, snapshot: Snapshot | File) -> None:
        """Continue from a snapshot of such an environment.

        Args:
            snapshot: Result of `snapshot`, or path of its file.

        Raises:
            ValueError: The snapshot is from another robot, scene, task or number of environments.
        """
        with self._exclusive():
            self.batch.restore(snapshot)

    @property
    def n_diverged(self) -> int:
        """Number of episodes so far that ended because the robot diverged; waits for a GPU."""
        return int(self.batch.rows("failures").sum())

    def set_command(self, command: Any) -> None:
        """Set the commanded velocities until the task draws new ones.

        Args:
            command: Forward [m/s], sideways [m/s], yaw rate [rad/s], shape (3,) or (num_envs, 3).

        Raises:
            ValueError: The shape is wrong or a number is not finite.
            RuntimeError: Another thread steps or resets this environment.
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        batch = self.batch
        rows = finite_array("command", command, batch.dtype, (3,), (batch.num_envs, 3))
        with self._exclusive():
            batch.write("command", rows)

    def _keys(self, seed: Any) -> NDArray[np.uint64]:
        """Return the keys of the random streams, shape (num_envs,): s, s + 1, ... for one seed `s`."""
        n = self.batch.num_envs
        if isinstance(seed, str) or not hasattr(seed, "__len__"):
            return np.arange(n, dtype=np.uint64) + np.uint64(checked_seed(seed))
        if len(seed) != n or any(s is None for s in seed):
            raise ValueError(f"seed has {len(seed)} entries; expected {n} whole numbers")
        return np.array([checked_seed(s) for s in seed], np.uint64)

    def _observation(self, rows: Array) -> Any:
        """Return rows (..., n_obs) in the form of the observation space: the policy's part, or a dictionary of both.

        The parts are new arrays, or views of arrays that no later step writes.
        """
        program = self.batch.program
        is_reused = self.batch.num_envs > 1 and not self.batch.fused
        copy = np.array if is_reused else lambda part: part
        policy = copy(rows[..., : program.observation_size])
        if not self._as_dict:
            return policy
        return {"policy": policy, "critic": copy(rows[..., -(program.critic_size or program.observation_size) :])}

    @property
    def _title(self) -> str:
        return f"{type(self).__name__} {self.task!r} of {self.batch.num_envs} {self.batch.program.model.robot.name}"

    def _exclusive(self) -> CriticalSection:
        """Return the critical section for a call that changes the state: complete or without effect, one at a time.

        Raises:
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        if self.closed:
            raise ClosedEnvironmentError(f"{self._title}: called after close(), expected a new environment")
        return self._section

    def state(self) -> dict[str, Array]:
        """Return copies of the recorded state by name, one robot per row.

        `q` (n, nq), `v` (n, nv), `command` (n, 3), `torque` of the motors at the joints (n, n_joints) [N m] and, if
        computed, `contact_forces` (n, n_contacts, 3) [N].
        """
        batch = self.batch
        state = {name: batch.rows(name) for name in ("q", "v", "command", "torque")}
        if batch.program.contact_forces:
            state["contact_forces"] = batch.rows("contact_forces").reshape(batch.num_envs, -1, 3)
        return state

    @property
    def dt(self) -> float:
        """Length of a control step [s]."""
        return self.batch.program.control_dt

    @property
    def contact_names(self) -> tuple[str, ...]:
        """Names of the contact spheres that the physics computes, in the order of `contact_forces`."""
        return self.batch.program.contacts

    @property
    def observation_structure(self) -> dict[str, int]:
        """Length of each observation block, in order."""
        return self.batch.program.observation_sizes

    @property
    def critic_structure(self) -> dict[str, int]:
        """Length of each block of the critic's observation, in order; the policy's if the critic has no others."""
        program = self.batch.program
        return dict(program.stages.block_sizes) if program.critic_size else program.observation_sizes

    def policy_spec(self) -> dict[str, Any]:
        """Return the specification to run a policy of this environment elsewhere; see `ce_gym.envs.policy_spec`."""
        return policy_spec(self.batch.program, self.task)

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """The left-right reflection of observations and actions; None if robot or task are not symmetric."""
        return left_right(self.batch.program)

    def differentiable(self, largest: float = np.inf) -> DifferentiableEnv:
        """Return the control steps of this environment with gradients; see `DifferentiableEnv`.

        Args:
            largest: Largest norm of the gradient of a robot that passes from a control step to the one before.
        """
        return DifferentiableEnv(self, largest)

    @cached_property
    def _observation_function(self) -> ca.Function:
        return self.batch.program.stages.observation_function()

    def look(self, state: Mapping[str, NDArray]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Observe robots of another simulator with the terms of this environment.

        Args:
            state: State that the terms read, by name, one robot per row: `q` (n, nq), `v` (n, nv), `command` (n, 3),
                the last `action` (n, n_actions), `clock`, the control steps since the start (n, 1), and so on.

        Returns:
            Observation of the policy without noise and history, shape (n, n_obs); whether the terminations of the task
            end the episode, shape (n,).

        Raises:
            ValueError: A part of the state that the terms read is missing, or a termination is an `@njit` function.
        """
        function = self._observation_function
        names = function.name_in()
        if called := [name for name in names if name in self.batch.program.stages.njit_values]:
            raise ValueError(f"{self.task}: {called[0]} is an @njit function; expected terms written with CasADi")
        if missing := [name for name in names if name not in state]:
            raise ValueError(f"{self.task}: the state lacks {', '.join(missing)}; expected all of {', '.join(names)}")
        *blocks, failed = function.call([ca.DM(np.asarray(state[name], float).T) for name in names])
        observation = np.concatenate([block.full() for block in blocks]).T
        clipped = np.clip(observation, -OBSERVATION_BOUND, OBSERVATION_BOUND)
        return clipped.astype(np.float32), failed.full()[0] > 0.5


def spaces(program: TaskProgram, obs_mode: str) -> tuple[Any, Any]:
    """Return observation and action space of one robot.

    Raises:
        ValueError: The mode does not exist.
    """
    check_choice("obs_mode", obs_mode, ("vector", "dict"))
    bound = OBSERVATION_BOUND
    policy = Box(-bound, bound, (program.observation_size,), np.float32)
    actions = Box(-1.0, 1.0, (program.n_actions,), np.float32)
    if obs_mode == "vector":
        return policy, actions
    critic = Box(-bound, bound, (program.critic_size or program.observation_size,), np.float32)
    return Dict({"policy": policy, "critic": critic}), actions


def checked_action(action: Any, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return an action as contiguous float32 rows.

    Raises:
        ValueError: The action is not an array of finite numbers of this shape.
    """
    rows = real_array("action", action)
    if rows.shape not in ((shape, shape[1:]) if shape[0] == 1 else (shape,)):
        raise ValueError(f"action has shape {np.shape(action)}; expected {shape if shape[0] > 1 else shape[1:]}")
    if not np.isfinite(rows).all():
        raise ValueError("action holds a number that is not finite")
    if rows.dtype != np.float32:
        rows = np.clip(rows, -1.0, 1.0)  # as in the kernel; large numbers do not fit into float32
    return np.ascontiguousarray(rows, dtype=np.float32).reshape(shape)


def checked_seed(seed: Any) -> int:
    """Return the seed of one environment as an int.

    Raises:
        ValueError: The seed is not a whole number from 0 to 2**62.
    """
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    check("seed", seed, whole and 0 <= seed <= 2**62, "a whole number from 0 to 2**62")
    return int(seed)


def check_options(options: Mapping[str, Any] | None, known: tuple[str, ...] = ()) -> None:
    """Check the options of a reset.

    Raises:
        ValueError: There is an unknown option.
    """
    for name in options or ():
        if name not in known:
            raise ValueError(f"options[{name!r}] has no effect in reset; expected {' or '.join(known) or 'no options'}")
