"""Steps of a simulator as a pure function of arrays, and its gradient; `adapters.torch` and `adapters.jax` wrap it.

torch and JAX need gradients with respect to coordinates, quaternions included. `StepDerivatives` has gradients in the
tangent space of positions, so gradients are converted in both directions. The result has no component along the
quaternion itself, because the length of a quaternion has no effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym import Simulator, StepDerivatives

Rows = Mapping[str, NDArray]
"""State of all robots by name, shape (num_envs, size) each."""


class PureSteps:
    """Steps that depend only on their arguments and the parameters of the simulator.

    Args:
        simulator: Simulator; its state is overwritten.
        n_substeps: Number of sub-steps per call.
        keep_every: Number of sub-steps between two stored states, see `StepDerivatives`.
    """

    def __init__(self, simulator: Simulator, n_substeps: int = 1, keep_every: int = 1) -> None:
        self.derivatives, self.n_substeps = StepDerivatives(simulator, keep_every), n_substeps
        self.simulator, self.parts = simulator, tuple(self.derivatives.state_sizes)

    def state(self) -> dict[str, NDArray]:
        """Return the current state of the simulator."""
        return self.derivatives.state()

    def forward(self, state: Rows, target: NDArray, record: bool = True) -> tuple[dict[str, NDArray], Any]:
        """Return the state after the steps and, if `record`, the data that `backward` needs."""
        self.derivatives.restore(state)
        normalised, q = self.simulator.q, np.asarray(state["q"])
        if not record:
            self.simulator.step(target, self.n_substeps)
            return self.state(), None
        self.derivatives.take()
        self.derivatives.step(target, self.n_substeps)
        after = self.state()
        return after, (self.derivatives.take(), normalised, q, after["q"])

    def backward(self, recorded: Any, weights: Rows) -> tuple[dict[str, NDArray], NDArray]:
        """Return gradients with respect to state and target, from those with respect to the state after the steps."""
        records, normalised, q, after = recorded
        layout = self.simulator.model.robot.layout
        weights = {**weights, "q": to_tangent(after, weights["q"], layout)}
        gradient, targets, _ = self.derivatives.backward(weights, records)
        gradient["q"] = from_tangent(normalised, gradient["q"], layout)
        for row, _ in layout.turns:  # a step first scales quaternions to unit length
            gradient["q"][:, row : row + 4] /= np.linalg.norm(q[:, row : row + 4], axis=1, keepdims=True)
        return gradient, sum(targets[1:], start=targets[0])


def to_tangent(q: NDArray, gradient: NDArray, layout: Any) -> NDArray:
    """Convert gradients from positions, shape (n, nq), to their tangent space, (n, nv); see `Robot.layout`."""
    parts = []
    for row, _ in layout.turns:
        w, u = q[:, row : row + 1], q[:, row + 1 : row + 4]
        scalar, vector = gradient[:, row : row + 1], gradient[:, row + 1 : row + 4]
        parts.append((w * vector - scalar * u - np.cross(u, vector)) / 2)
    if layout.floating:
        parts.insert(1, _rotate(q[:, 3:4], -q[:, 4:7], gradient[:, :3]))
    return np.hstack([*parts, gradient[:, layout.joints_q :]])


def from_tangent(q: NDArray, gradient: NDArray, layout: Any) -> NDArray:
    """Convert gradients from the tangent space of positions, shape (n, nv), to positions, (n, nq)."""
    parts = [_rotate(q[:, 3:4], q[:, 4:7], gradient[:, 3:6])] if layout.floating else []
    for row, column in layout.turns:
        w, u, g = q[:, row : row + 1], q[:, row + 1 : row + 4], gradient[:, column : column + 3]
        parts += [-2 * (u * g).sum(1, keepdims=True), 2 * (w * g + np.cross(u, g))]
    return np.hstack([*parts, gradient[:, layout.joints_v :]])


def _rotate(w: NDArray, u: NDArray, x: NDArray) -> NDArray:
    """Return vectors x (n, 3) rotated by unit quaternions with scalar part w (n, 1) and vector part u (n, 3)."""
    return x + 2 * np.cross(u, np.cross(u, x) + w * x)
