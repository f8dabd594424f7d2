"""Steps of a simulator as a function of JAX arrays, with gradients through contact.

    step = make_steps(sim, n_substeps=4)
    gradient = jax.grad(lambda target: loss(step(state, target)))(target)

On the CPU, compiled functions run the steps without Python and without the GIL. Callbacks of Python run the backward
pass, and steps on other devices or in several threads. The backward pass repeats the steps, because a JAX function
cannot keep intermediate results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any
from uuid import uuid4

import numpy as np

from ce_gym import Simulator
from ce_gym.adapters.pure_steps import PureSteps
from ce_gym.model.coordinates import UNIT_TOLERANCE

jax: Any = import_module("jax")  # ce_gym has no extra for JAX; its types may be missing
jnp: Any = import_module("jax.numpy")

State = Mapping[str, Any]
"""State of all robots by name, shape (num_envs, size) each; "q" are coordinates with quaternions."""

_kept: list[Any] = []
"""What registered functions need: XLA may call them until the process ends."""


def make_steps(
    simulator: Simulator, n_substeps: int = 1, keep_every: int = 1
) -> tuple[Callable[[State, Any], State], State]:
    """Return a function (state, target) -> state after the steps, and the current state of the simulator.

    Robots get NaN if their target is not finite or if the norm of a quaternion is not within 1e-3 of 1; callbacks
    raise an error instead.

    Args:
        simulator: Simulator on the CPU with the same precision as the arrays; callbacks overwrite its state. With
            `num_threads=1` steps need numba; with more threads they are callbacks.
        n_substeps: Number of sub-steps per call, with the same target.
        keep_every: Number of sub-steps between two stored states, see `ce_gym.StepDerivatives`.

    Raises:
        ValueError: If the simulator's steps cannot be differentiated, or later, if an array has a wrong shape or dtype.
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

    def call_python(state: State, target: Any) -> State:
        return jax.pure_callback(step, shapes, state, target, vmap_method="sequential")

    on_cpu = _compiled_steps(simulator, pure.parts, n_substeps) if simulator.num_threads == 1 else call_python

    @jax.custom_vjp
    def steps(state: State, target: Any) -> State:
        _check({**state, "target": target}, {**shapes, "target": target_shape})
        return jax.lax.platform_dependent(state, target, cpu=on_cpu, default=call_python)

    steps.defvjp(
        lambda state, target: (steps(state, target), (state, target)),
        lambda inputs, weights: jax.pure_callback(
            pull_back, (shapes, target_shape), *inputs, weights, vmap_method="sequential"
        ),
    )
    return steps, start


def _compiled_steps(simulator: Simulator, parts: tuple[str, ...], n_substeps: int) -> Callable[[State, Any], State]:
    """Return the steps as a function that XLA calls without Python; the function does not change the simulator."""
    from ce_gym.adapters.xla_handler import kernel_handler  # needs numba

    kernel, n, dtype = simulator._kernel, simulator.num_envs, simulator.dtype
    arrays, schema = simulator._arrays | simulator._batch.tables, simulator._batch.schema
    names = [buffer.name for buffer in kernel.arguments]
    changed = [name for name in names if name in schema and schema[name].writer == "physics"]
    fixed = {name: arrays[name] for name in names if name not in (*changed, "target")}
    handler, n_bytes = kernel_handler(kernel, n, fixed, changed, n_substeps)
    _kept.append((fixed, handler))
    name = f"ce_gym_steps_{uuid4().hex}"  # another process must not find the function in a cache of XLA
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(handler.address), platform="cpu")
    results = [jax.ShapeDtypeStruct(arrays[x].shape, dtype) for x in changed]
    results.append(jax.ShapeDtypeStruct((n_bytes,), np.uint8))
    aliases = {i: i for i in range(len(changed))}
    call = jax.ffi.ffi_call(name, results, input_output_aliases=aliases, vmap_method="sequential")
    turns = [row for row, _ in simulator.model.robot.layout.turns]

    def in_tiles(rows: Any) -> Any:
        padded = jnp.pad(rows, ((0, -n % kernel.lanes), (0, 0)), mode="edge")
        return padded.reshape(-1, kernel.lanes, rows.shape[1]).transpose(0, 2, 1)

    def in_rows(tiles: Any) -> Any:
        return tiles.transpose(0, 2, 1).reshape(-1, tiles.shape[1])[:n]

    def steps(state: State, target: Any) -> State:
        valid = jnp.isfinite(target).all(axis=1)
        for row in turns:
            norm = jnp.linalg.norm(state["q"][:, row : row + 4], axis=1)
            valid &= jnp.abs(norm - 1) <= UNIT_TOLERANCE  # the kernel scales them to 1
        tiles = {name: in_tiles(rows) for name, rows in state.items()}
        targets = [target] if "target" in names else []  # none without motors
        before = [tiles[name] if name in tiles else jnp.zeros(arrays[name].shape, dtype) for name in changed]
        after = dict(zip(changed, call(*before, *targets)[:-1], strict=True))
        return {part: jnp.where(valid[:, None], in_rows(after[part]), np.nan) for part in parts}

    return steps


def _check(given: State, expected: dict[str, Any]) -> None:
    for name, wanted in expected.items():
        got = given[name]
        if (got.shape, got.dtype) != (wanted.shape, wanted.dtype):
            expectation = f"{wanted.dtype} {wanted.shape}; float64 needs jax_enable_x64"
            raise ValueError(f"{name} is {got.dtype} {got.shape}; expected {expectation}")


def _rows(parts: State) -> dict[str, np.ndarray]:
    return {name: np.asarray(rows) for name, rows in parts.items()}
