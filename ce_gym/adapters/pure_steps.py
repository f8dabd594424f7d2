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
        before, given = self.simulator.q, np.asarray(state["q"])
        if not record:
            self.simulator.step(target, self.n_substeps)
            return self.state(), None
        self.derivatives.take()
        self.derivatives.step(target, self.n_substeps)
        after = self.state()
        return after, (self.derivatives.take(), before, given, after["q"])

    def backward(self, recorded: Any, weights: Rows) -> tuple[dict[str, NDArray], NDArray]:
        """Return gradients with respect to the state and the target, given those with respect to the state after."""
        records, before, given, after = recorded
        layout = self.simulator.model.robot.layout
        weights = {**weights, "q": to_tangent(after, weights["q"], layout)}
        found, targets, _ = self.derivatives.backward(weights, records)
        found["q"] = from_tangent(before, found["q"], layout)
        for row, _ in layout.turns:  # steps scale quaternions to unit length first
            found["q"][:, row : row + 4] /= np.linalg.norm(given[:, row : row + 4], axis=1, keepdims=True)
        return found, sum(targets[1:], start=targets[0])


def to_tangent(q: NDArray, gradient: NDArray, layout: Any) -> NDArray:
    """Take gradients with respect to positions, shape (n, nq), to their tangent space, (n, nv); see `Robot.layout`."""
    parts = []
    for row, _ in layout.turns:
        w, u = q[:, row : row + 1], q[:, row + 1 : row + 4]
        scalar, vector = gradient[:, row : row + 1], gradient[:, row + 1 : row + 4]
        parts.append((w * vector - scalar * u - np.cross(u, vector)) / 2)
    if layout.floating:
        parts.insert(1, _turned(q[:, 3:4], -q[:, 4:7], gradient[:, :3]))
    return np.hstack([*parts, gradient[:, layout.joints_q :]])


def from_tangent(q: NDArray, gradient: NDArray, layout: Any) -> NDArray:
    """Take gradients in the tangent space of positions, shape (n, nv), to one with respect to them, (n, nq)."""
    parts = [_turned(q[:, 3:4], q[:, 4:7], gradient[:, 3:6])] if layout.floating else []
    for row, column in layout.turns:
        w, u, g = q[:, row : row + 1], q[:, row + 1 : row + 4], gradient[:, column : column + 3]
        parts += [-2 * (u * g).sum(1, keepdims=True), 2 * (w * g + np.cross(u, g))]
    return np.hstack([*parts, gradient[:, layout.joints_v :]])


def _turned(w: NDArray, u: NDArray, x: NDArray) -> NDArray:
    return x + 2 * np.cross(u, np.cross(u, x) + w * x)
