"""Steps of a simulator as a function of JAX arrays, with gradients through contact.

    step = make_steps(sim, n_substeps=4)
    gradient = jax.grad(lambda target: loss(step(state, target)))(target)

They are made on the CPU by callbacks, also in compiled functions. The way back makes the steps once more, since a
function of JAX has no memory.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np

from ce_gym import Simulator
from ce_gym.adapters.pure_steps import PureSteps

jax: Any = import_module("jax")  # no extra of ours: it may be absent, and so may its types

State = Mapping[str, Any]
"""Parts of the state of all robots by name, shape (num_envs, size) each; "q" are coordinates, quaternions included."""


def make_steps(
    simulator: Simulator, n_substeps: int = 1, keep_every: int = 1
) -> tuple[Callable[[State, Any], State], State]:
    """Return a function (state, target) -> state after the steps, and the state that the simulator is in.

    Args:
        simulator: What makes the steps, of the same precision as the arrays; its state is overwritten.
        n_substeps: How many sub-steps are made at a time, with the same target.
        keep_every: Every how many sub-steps the state is kept, see `ce_gym.StepDerivatives`.

    Raises:
        ValueError: If the simulator's steps cannot be differentiated.
    """
    pure = PureSteps(simulator, n_substeps, keep_every)
    start = pure.state()
    shapes = {name: jax.ShapeDtypeStruct(rows.shape, rows.dtype) for name, rows in start.items()}
    of_target = jax.ShapeDtypeStruct((simulator.num_envs, len(simulator.target_names)), simulator.dtype)

    def stepped(state: State, target: Any) -> State:
        return pure.forward(_rows(state), np.asarray(target), record=False)[0]

    def pulled_back(state: State, target: Any, weights: State) -> tuple[State, Any]:
        _, recorded = pure.forward(_rows(state), np.asarray(target))
        found, by_target = pure.backward(recorded, _rows(weights))
        return {name: rows.astype(simulator.dtype) for name, rows in found.items()}, by_target.astype(simulator.dtype)

    @jax.custom_vjp
    def steps(state: State, target: Any) -> State:
        return jax.pure_callback(stepped, shapes, state, target)

    steps.defvjp(
        lambda state, target: (steps(state, target), (state, target)),
        lambda given, weights: jax.pure_callback(pulled_back, (shapes, of_target), *given, weights),
    )
    return steps, start


def _rows(parts: State) -> dict[str, np.ndarray]:
    return {name: np.asarray(rows) for name, rows in parts.items()}
