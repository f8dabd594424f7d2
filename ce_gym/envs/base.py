"""What single and vector environments have in common. May know batches, and Gymnasium's errors."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from gymnasium.error import ClosedEnvironmentError
from numpy.typing import NDArray

from ce_gym.compile import CriticalSection
from ce_gym.envs.policy_spec import contract
from ce_gym.envs.runtime.batch import Batch
from ce_gym.envs.runtime.program import OBSERVATION_BOUND
from ce_gym.envs.runtime.symmetry import Symmetry, left_right


class BatchShell:
    """Base of environments that are shells over a batch.

    Attributes:
        batch: The batch.
        task: Name of the task.
        closed: Whether it has been closed.
    """

    batch: Batch
    task: str
    closed: bool
    _section: CriticalSection

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

    def contract(self) -> dict[str, Any]:
        """What somebody must know to run a policy of this environment elsewhere; see `ce_gym.envs.policy_spec`."""
        return contract(self.batch.program, self.task)

    @cached_property
    def symmetry(self) -> Symmetry | None:
        """The left-right reflection of observations and actions, None if the robot or its task has none.

        Examples:
            >>> symmetry = gymnasium.make("ce_gym/MiniCheetahVelocity-v0").unwrapped.symmetry
            >>> observation = np.arange(48.0)
            >>> print(symmetry.observation(observation)[:3], symmetry.action.index)
            [ 0. -1.  2.] [ 3  4  5  0  1  2  9 10 11  6  7  8]
        """
        return left_right(self.batch.program)

    @cached_property
    def _look(self) -> ca.Function:
        return self.batch.program.look()

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
