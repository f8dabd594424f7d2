"""What single and vector environments tell about the batch behind them. May know batches; no Gymnasium."""

from __future__ import annotations

from ce_gym.envs.batch import Batch


class BatchShell:
    """Base of environments that are shells over a batch.

    Attributes:
        batch: The batch.
    """

    batch: Batch

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
