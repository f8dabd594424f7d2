"""Steps of a simulator as a pure function of arrays, and its gradient: what `torch` and `jax` here wrap.

Both take gradients with respect to coordinates, quaternions included. Gradients to the tangent space of positions are
taken there and back: what comes out is the one that has no part along the quaternion itself, by which nothing moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym import Simulator, StepDerivatives

Rows = Mapping[str, NDArray]
"""Parts of the state of all robots by name, shape (num_envs, size) each."""


class PureSteps:
    """Steps that depend on nothing but what they are given, apart from parameters of the simulator.

    Args:
        simulator: What makes the steps; its state is overwritten.
        n_substeps: How many sub-steps are made at a time.
        keep_every: See `StepDerivatives`.
    """

    def __init__(self, simulator: Simulator, n_substeps: int = 1, keep_every: int = 1) -> None:
        self.derivatives, self.n_substeps = StepDerivatives(simulator, keep_every), n_substeps
        self.simulator, self.parts = simulator, tuple(self.derivatives.state_sizes)

    def state(self) -> dict[str, NDArray]:
        """Return the state that the simulator is in."""
        return self.derivatives.state()

    def forward(self, state: Rows, target: NDArray, record: bool = True) -> tuple[dict[str, NDArray], Any]:
        """Return the state after the steps, and what `backward` needs, if they are recorded."""
        self.derivatives.restore(state)
        if not record:
            self.simulator.step(target, self.n_substeps)
            return self.state(), None
        self.derivatives.take()
        self.derivatives.step(target, self.n_substeps)
        after = self.state()
        return after, (self.derivatives.take(), state["q"], after["q"])

    def backward(self, recorded: Any, weights: Rows) -> tuple[dict[str, NDArray], NDArray]:
        """Return gradients with respect to the state and the target, given those with respect to the state after."""
        records, before, after = recorded
        if self.simulator.model.robot.floating:
            weights = {**weights, "q": to_tangent(after, weights["q"])}
        found, targets, _ = self.derivatives.backward(weights, records)
        if self.simulator.model.robot.floating:
            found["q"] = from_tangent(before, found["q"])
        return found, sum(targets[1:], start=targets[0])


def to_tangent(q: NDArray, gradient: NDArray) -> NDArray:
    """Take gradients with respect to positions of a floating base, shape (n, nq), to their tangent space, (n, nv)."""
    w, u = q[:, 3:4], q[:, 4:7]
    scalar, vector = gradient[:, 3:4], gradient[:, 4:7]
    turning = (w * vector - scalar * u - np.cross(u, vector)) / 2
    return np.hstack([turning, _turned(w, -u, gradient[:, :3]), gradient[:, 7:]])


def from_tangent(q: NDArray, gradient: NDArray) -> NDArray:
    """Take gradients in the tangent space of positions, shape (n, nv), to one with respect to them, (n, nq)."""
    w, u, g = q[:, 3:4], q[:, 4:7], gradient[:, :3]
    scalar, vector = -(u * g).sum(1, keepdims=True), w * g + np.cross(u, g)
    return np.hstack([_turned(w, u, gradient[:, 3:6]), 2 * scalar, 2 * vector, gradient[:, 6:]])


def _turned(w: NDArray, u: NDArray, x: NDArray) -> NDArray:
    return x + 2 * np.cross(u, np.cross(u, x) + w * x)
