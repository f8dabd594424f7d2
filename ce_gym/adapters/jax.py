"""Steps of a simulator as a function of JAX arrays, with gradients through contact.

    step = make_steps(sim, n_substeps=4)
    gradient = jax.grad(lambda target: loss(step(state, target)))(target)

The steps run on the CPU, by callbacks, also inside compiled functions. The backward pass repeats the steps, because a
JAX function cannot keep intermediate results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np

from ce_gym import Simulator
from ce_gym.adapters.pure_steps import PureSteps

jax: Any = import_module("jax")  # ce_gym has no extra for JAX; its types may be missing

State = Mapping[str, Any]
"""State of all robots by name, shape (num_envs, size) each; "q" are coordinates with quaternions."""


def make_steps(
    simulator: Simulator, n_substeps: int = 1, keep_every: int = 1
) -> tuple[Callable[[State, Any], State], State]:
    """Return a function (state, target) -> state after the steps, and the current state of the simulator.

    Args:
        simulator: Simulator with the same precision as the arrays; its state is overwritten.
        n_substeps: Number of sub-steps per call, with the same target.
        keep_every: Number of sub-steps between two stored states, see `ce_gym.StepDerivatives`.

    Raises:
        ValueError: If the simulator's steps cannot be differentiated.
    """
    pure = PureSteps(simulator, n_substeps, keep_every)
    start = pure.state()
    shapes = {name: jax.ShapeDtypeStruct(rows.shape, rows.dtype) for name, rows in start.items()}
    target_shape = jax.ShapeDtypeStruct((simulator.num_envs, len(simulator.target_names)), simulator.dtype)

    def step(state: State, target: Any) -> State:
        return pure.forward(_rows(state), np.asarray(target), record=False)[0]

    def pull_back(state: State, target: Any, weights: State) -> tuple[State, Any]:
        _, recorded = pure.forward(_rows(state), np.asarray(target))
        by_state, by_target = pure.backward(recorded, _rows(weights))
        dtype = simulator.dtype
        return {name: rows.astype(dtype) for name, rows in by_state.items()}, by_target.astype(dtype)

    @jax.custom_vjp
    def steps(state: State, target: Any) -> State:
        return jax.pure_callback(step, shapes, state, target)

    steps.defvjp(
        lambda state, target: (steps(state, target), (state, target)),
        lambda inputs, weights: jax.pure_callback(pull_back, (shapes, target_shape), *inputs, weights),
    )
    return steps, start


def _rows(parts: State) -> dict[str, np.ndarray]:
    return {name: np.asarray(rows) for name, rows in parts.items()}
