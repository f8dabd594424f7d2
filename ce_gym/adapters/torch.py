"""Steps of a simulator as a function of torch tensors, with gradients through contact.

steps = Steps(sim, n_substeps=4)
state = steps.state()
state = steps(state, target)
loss(state).backward()
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ce_gym import Simulator
from ce_gym.adapters.pure_steps import PureSteps

State = Mapping[str, torch.Tensor]
"""State of all robots by name, shape (num_envs, size) each; "q" are coordinates with quaternions."""


class Steps:
    """Steps of a simulator on the CPU that torch's autograd differentiates; tensors share memory with numpy arrays.

    Args:
        simulator: Simulator; its state is overwritten.
        n_substeps: Number of sub-steps per call, with the same target.
        keep_every: Number of sub-steps between two stored states, see `ce_gym.StepDerivatives`.

    Raises:
        ValueError: If the simulator's steps cannot be differentiated.
    """

    def __init__(self, simulator: Simulator, n_substeps: int = 1, keep_every: int = 1) -> None:
        self._pure = PureSteps(simulator, n_substeps, keep_every)

    def state(self) -> dict[str, torch.Tensor]:
        """Return the current state of the simulator."""
        return {name: torch.from_numpy(rows) for name, rows in self._pure.state().items()}

    def __call__(self, state: State, target: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the state after the steps.

        Args:
            state: State before the steps, with all entries that the method `state` returns.
            target: As for `Simulator.step`, shape (num_envs, n_targets).
        """
        parts = self._pure.parts
        after = _Steps.apply(self._pure, target, *[state[name] for name in parts])
        return dict(zip(parts, after, strict=True))


class _Steps(torch.autograd.Function):
    """One call of `Steps`; it can be differentiated once."""

    @staticmethod
    def forward(ctx: Any, pure: PureSteps, target: torch.Tensor, *state: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rows = {name: tensor.detach().numpy() for name, tensor in zip(pure.parts, state, strict=True)}
        after, ctx.recorded = pure.forward(rows, target.detach().numpy(), record=any(ctx.needs_input_grad))
        ctx.pure = pure
        return tuple(torch.from_numpy(after[name]) for name in pure.parts)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        pure, dtype = ctx.pure, gradients[0].dtype
        weights = {name: gradient.numpy() for name, gradient in zip(pure.parts, gradients, strict=True)}
        state, target = pure.backward(ctx.recorded, weights)
        return None, *(torch.from_numpy(rows).to(dtype) for rows in (target, *(state[name] for name in pure.parts)))
