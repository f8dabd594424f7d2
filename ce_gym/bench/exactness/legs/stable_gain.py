"""The largest stable gain of a controller that knows a leg at one level, from the linearised, sampled loop."""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.bench.exactness.legs.control import law
from ce_gym.bench.exactness.legs.signals import foot_at
from ce_gym.bench.exactness.mechanisms import leg_on_stand, without_limits
from ce_gym.bench.exactness.protocol import HIGHEST_BANDWIDTH, HOLD, Array, Leg
from ce_gym.dynamics.model import Model

STEPS, BISECTIONS = 400, 40
"""Points of the search for the first unstable gain, and halvings after it."""


def sampled_plant(model: Model, q: Array) -> tuple[Array, Array]:
    """Return A and B of (q, v) at rest at a pose, its torque held for a sample: the exponential of [[A, B], [0, 0]]."""
    n, still = model.nv, np.zeros(model.nv)
    by_q, by_v, by_tau = model.forward_dynamics_derivatives(q, still, model.inverse_dynamics(q, still, still))
    rates = np.zeros((3 * n, 3 * n))
    rates[:n, n : 2 * n] = np.eye(n)
    rates[n : 2 * n] = np.hstack([by_q, by_v, by_tau])
    term = whole = np.eye(3 * n)
    for k in range(1, 25):
        term = term @ rates * (HOLD / k)
        whole = whole + term
    return whole[: 2 * n, : 2 * n], whole[: 2 * n, 2 * n :]


def feedback(model: Model, controller: str) -> ca.Function:
    """Return d tau / d (q, v) of a controller that holds a pose, as a function of the pose, the foot and w [rad/s]."""
    one = law(model, controller)
    given = one.sx_in()
    slope = ca.Function("slope", given, [ca.jacobian(one(*given), ca.vertcat(*given[:2]))])
    q, x, w = ca.SX.sym("q", model.nv), ca.SX.sym("x", given[2].shape[0]), ca.SX.sym("w")
    still, at_rest = ca.SX(x.shape[0], 1), ca.SX(model.nv, 1)
    return ca.Function("feedback", [q, x, w], [slope(q, at_rest, x, still, still, q, at_rest, at_rest, w)])


def largest_bandwidth(leg: Leg, level: str, controller: str, poses: Array) -> Array:
    """Return the natural frequency up to which a loop is stable [Hz], shape (n_poses,); at most the search's end."""
    robot = without_limits(leg_on_stand(leg))
    exact, slope = Model(robot), feedback(Model(robot, level), controller)
    return np.array([_first_unstable(exact, slope, controller, q) for q in poses])


def _first_unstable(exact: Model, slope: ca.Function, controller: str, q: Array) -> float:
    A, B = sampled_plant(exact, q)
    aim = foot_at(exact, q) if controller == "foot" else q

    def stable(hz: float) -> bool:
        K = np.asarray(slope(q, aim, 2 * np.pi * hz).full())
        return bool(np.abs(np.linalg.eigvals(A + B @ K)).max() < 1.0)

    grid = np.geomspace(1.0, HIGHEST_BANDWIDTH, STEPS)
    high = next((i for i, hz in enumerate(grid) if not stable(hz)), None)
    if high is None:
        return HIGHEST_BANDWIDTH
    low, top = (grid[high - 1] if high else 0.0), grid[high]
    for _ in range(BISECTIONS):
        middle = (low + top) / 2
        low, top = (middle, top) if stable(middle) else (low, middle)
    return low
