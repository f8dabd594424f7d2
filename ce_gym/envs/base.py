"""What single and vector environments have in common."""

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
from ce_gym.sim.arguments import check, check_choice
from ce_gym.sim.batch import File, Snapshot
from ce_gym.sim.devices import Array


class BaseEnv(EzPickle):
    """Base of the environments; they are thin over a batch.

    Attributes:
        batch: The batch.
        task: Name of the task.
        model: The robot at a transmission level.
        closed: Whether it has been closed.
    """

    closed = False

    def _hold(self, batch: TaskBatch, task: str, shown_as: Mapping[str, Any]) -> None:
        """Take a batch, and the arguments that say how it is shown."""
        self.batch, self.task, self.model = batch, task, batch.program.model
        self.render_mode, self._as_dict = shown_as["render_mode"], shown_as["obs_mode"] == "dict"
        self._screen = Screen(self.render_mode, batch, width=shown_as["width"], height=shown_as["height"])
        self._section = CriticalSection(self._title)

    def __getstate__(self) -> dict[str, Any]:
        own = {name: self.__dict__.get(name) for name in ("spec", "_np_random")}
        return {**EzPickle.__getstate__(self), "own": own, "state": self.snapshot()}

    def __setstate__(self, made: dict[str, Any]) -> None:
        self.__init__(*made["_ezpickle_args"], **made["_ezpickle_kwargs"])  # type: ignore[misc]
        self.__dict__.update(made["own"])
        self.restore(made["state"])

    def snapshot(self, file: File | None = None) -> Snapshot:
        """Return all that the robots carry, episodes and random streams included; `restore` continues bit for bit.

        Args:
            file: Where to write it besides, as `.npz`.

        Returns:
            Arrays by name, a row for each robot, copies in the memory of the CPU. Wrappers outside, such as Gymnasium's
            `TimeLimit`, have state of their own.
        """
        return self.batch.snapshot(file)

    def restore(self, snapshot: Snapshot | File) -> None:
        """Continue from a snapshot of such an environment.

        Args:
            snapshot: What `snapshot` returned, or the name of the file that it wrote.

        Raises:
            ValueError: If it is of other robots, another scene or another task.
        """
        with self._changing():
            self.batch.restore(snapshot)

    @property
    def n_diverged(self) -> int:
        """How many episodes have ended so far because the simulation failed; waits for a GPU."""
        return int(self.batch.rows("failures").sum())

    def set_command(self, command: Any) -> None:
        """Command velocities until the task draws new ones.

        Args:
            command: Forward [m/s], sideways [m/s], yaw rate [rad/s], shape (3,) or (num_envs, 3).

        Raises:
            ValueError: If the shape is wrong or a number is not finite.
            RuntimeError: If another thread steps or resets this environment.
            gymnasium.error.ClosedEnvironmentError: After `close`.
        """
        batch = self.batch
        given, shapes = batch.place.rows(command, batch.dtype), ((3,), (batch.num_envs, 3))
        if tuple(given.shape) not in shapes or not np.isfinite(batch.place.host(given)).all():
            expected = f"(3,) or {shapes[1]}, finite"
            raise ValueError(f"command has shape {tuple(given.shape)}; expected {expected}")
        with self._changing():
            batch.write("command", given)

    def _keys(self, seed: Any) -> NDArray[np.uint64]:
        """Return keys of random streams, shape (num_envs,): for one seed `s` those of s, s + 1, and so on."""
        n = self.batch.num_envs
        if isinstance(seed, str) or not hasattr(seed, "__len__"):
            return np.arange(n, dtype=np.uint64) + np.uint64(checked_seed(seed))
        if len(seed) != n or any(s is None for s in seed):
            raise ValueError(f"seed has {len(seed)} entries; expected {n} whole numbers")
        return np.array([checked_seed(s) for s in seed], np.uint64)

    def _shown(self, rows: Array) -> Any:
        """Return observation rows (..., n_obs) as the space has them: the policy's part, or a dictionary of both.

        Fresh arrays; of a GPU views of tensors that no later step writes to.
        """
        several = self.batch.num_envs > 1 and not self.batch.fused  # others are not touched again
        program, copied = self.batch.program, np.array if several else lambda part: part
        policy = copied(rows[..., : program.observation_size])
        if not self._as_dict:
            return policy
        return {"policy": policy, "critic": copied(rows[..., -(program.critic_size or program.observation_size) :])}

    @property
    def _title(self) -> str:
        return f"{type(self).__name__} {self.task!r} of {self.batch.num_envs} {self.batch.program.model.robot.name}"

    def _changing(self) -> CriticalSection:
        """Return the section of a call that changes the state: all of it or nothing, one call at a time.

        Raises:
            gymnasium.error.ClosedEnvironmentError: If it is closed.
        """
        if self.closed:
            raise ClosedEnvironmentError(f"{self._title}: called after close(), expected a new environment")
        return self._section

    def state(self) -> dict[str, Array]:
        """Return what a recorder needs, copies by name, one robot per row.

        q (n, nq); v (n, nv); command (n, 3); torque of the motors at the joints (n, n_joints) [N m]; and, if computed,
        contact_forces (n, n_contacts, 3) [N].
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
        """The contact spheres that take part, in the order of recorded contact forces."""
        return self.batch.program.contacts

    @property
    def observation_structure(self) -> dict[str, int]:
        """Length of each observation block, in order."""
        return self.batch.program.observation_sizes

    @property
    def critic_structure(self) -> dict[str, int]:
        """Length of each block of the critic's observation, in order; the policy's if the critic sees no more."""
        program = self.batch.program
        return dict(program.stages.block_sizes) if program.critic_size else program.observation_sizes

    def policy_spec(self) -> dict[str, Any]:
        """Return what is needed to run a policy of this environment elsewhere; see `ce_gym.envs.policy_spec`."""
        return policy_spec(self.batch.program, self.task)

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """The left-right reflection of observations and actions, None if the robot or its task has none."""
        return left_right(self.batch.program)

    def differentiable(self, largest: float = np.inf) -> DifferentiableEnv:
        """Return this environment's control steps with gradients; see `DifferentiableEnv`.

        Args:
            largest: A robot's carried gradient is shortened to this norm between control steps.
        """
        return DifferentiableEnv(self, largest)

    @cached_property
    def _look(self) -> ca.Function:
        return self.batch.program.stages.observation_function()

    def look(self, state: Mapping[str, NDArray]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Observe robots that something else simulates, through the same terms as the environment's own.

        Args:
            state: What the task looks at, by name, one robot per row: q (n, nq), v (n, nv), command (n, 3), the action
                just carried out (n, n_actions), clock (n, 1), the control steps since the start, and so on.

        Returns:
            One observation of the policy, without noise or history, shape (n, n_blocks); whether the task's conditions
            end the episode, shape (n,).

        Raises:
            ValueError: If something that the task looks at is missing.
        """
        names = self._look.name_in()
        missing = [name for name in names if name not in state]
        if missing:
            raise ValueError(f"{self.task}: looks at {', '.join(missing)}; expected all of {', '.join(names)}")
        *blocks, failed = self._look.call([ca.DM(np.asarray(state[name], float).T) for name in names])
        observation = np.concatenate([block.full() for block in blocks]).T
        clipped = np.clip(observation, -OBSERVATION_BOUND, OBSERVATION_BOUND)
        return clipped.astype(np.float32), failed.full()[0] > 0.5


def spaces(program: TaskProgram, obs_mode: str) -> tuple[Any, Any]:
    """Return observation and action space of one robot.

    Raises:
        ValueError: If the mode does not exist.
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
        ValueError: If it is not an array of numbers, its shape is wrong or it is not finite.
    """
    try:
        rows = np.asarray(action)
    except ValueError:  # lists of unequal lengths
        rows = np.empty(0, object)
    if rows.dtype.kind not in "fiu":
        raise ValueError(f"action is {_brief(action)}; expected an array of real numbers, such as float32")
    if rows.shape not in ((shape, shape[1:]) if shape[0] == 1 else (shape,)):
        raise ValueError(f"action has shape {np.shape(action)}; expected {shape if shape[0] > 1 else shape[1:]}")
    if not np.isfinite(rows).all():
        raise ValueError("action holds a number that is not finite")
    if rows.dtype != np.float32:
        rows = np.clip(rows, -1.0, 1.0)  # as the kernel does; a large number could not be converted
    return np.ascontiguousarray(rows, dtype=np.float32).reshape(shape)


def checked_seed(seed: Any) -> int:
    """Return a seed of one environment.

    Raises:
        ValueError: If it is not a whole number from 0 to 2**62.
    """
    whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    check("seed", seed, whole and 0 <= seed <= 2**62, "a whole number from 0 to 2**62")
    return int(seed)


def check_options(options: Mapping[str, Any] | None, known: tuple[str, ...] = ()) -> None:
    """Check the options of a reset.

    Raises:
        ValueError: If there is one that does nothing; one line.
    """
    for name in options or ():
        if name not in known:
            raise ValueError(f"options[{name!r}] means nothing to reset; expected {' or '.join(known) or 'no options'}")


def _brief(value: Any) -> str:
    kind = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
    return kind if value is not None else "None"
