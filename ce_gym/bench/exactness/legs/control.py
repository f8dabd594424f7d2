"""Controllers that know a leg at one transmission level, as functions: computed torque, and operational space."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from ce_gym.bench.exactness.protocol import Array
from ce_gym.dynamics.model import Model

INPUTS = ("q", "v", "x", "xd", "xdd", "rest", "restd", "restdd", "w")
"""State; place, velocity and acceleration asked for; those of the posture; natural frequency of the loop [rad/s]."""

ALONG = "foot, posture along"
"""Operational space whose posture moves with the foot, so that it asks for nothing while the foot is on its path."""


def law(model: Model, controller: str) -> ca.Function:
    """Return a critically damped controller that knows a model of a leg: from `INPUTS` to torques, "tau".

    Args:
        model: Of a leg with a fixed base and one contact, its foot.
        controller: "joints" for computed torque; otherwise operational space (Khatib 1987), whose inverse Jacobian is
            weighted by the mass matrix, and which takes the joints to a posture, at rest or moving, in its null space.
    """
    n = model.nv
    sizes = (n, n, *((n,) * 3 if controller == "joints" else (3,) * 3), n, n, n, 1)
    q, v, x, xd, xdd, rest, restd, restdd, w = given = [
        ca.SX.sym(name, size) for name, size in zip(INPUTS, sizes, strict=True)
    ]
    kp, kd = w**2, 2 * w
    if controller == "joints":
        vdot = xdd + kd * (xd - v) + kp * (x - q)
    else:
        foot, velocity = model.casadi_function("contact_points")(q, v)
        drift = model.casadi_function("contact_accelerations")(q, v, ca.SX(n, 1))
        J = ca.jacobian(foot, q)
        MJ = ca.solve(model.casadi_function("mass_matrix")(q), J.T)
        posture = restdd + kd * (restd - v) + kp * (rest - q)
        wanted = xdd + kd * (xd - velocity) + kp * (x - foot) - drift
        vdot = posture + MJ @ ca.solve(J @ MJ, wanted - J @ posture)
    tau = model.casadi_function("inverse_dynamics")(q, v, vdot)
    return ca.Function(f"{controller.split(',')[0]}_{model.transmission}", given, [tau], INPUTS, ["tau"])


class Controllers:
    """Controllers of one kind that know one leg at several levels, each for the same number of states.

    Args:
        exact: Of the leg, with whose torques the others are compared.
        models: Of the leg, at the levels that are known.
        controller: As for `law`.
        count: Number of states of each level.
    """

    def __init__(self, exact: Model, models: Sequence[Model], controller: str, count: int) -> None:
        ideal = law(exact, controller)
        self._laws = [_beside(law(model, controller), ideal).map(count) for model in models]

    def __call__(self, *columns: Array) -> tuple[Array, Array]:
        """Return torques, and those of an exact controller in the same states, each shape (n_levels, count, n).

        Args:
            columns: `INPUTS`, shape (n_levels, count, size) each, or (count, size) for what is the same at all levels.
        """
        answers = []
        for level, one in enumerate(self._laws):
            rows = [np.ascontiguousarray((c if c.ndim == 2 else c[level]).T) for c in columns]
            answers.append([np.asarray(x.full()).T for x in one.call(rows)])
        torque, ideal = zip(*answers, strict=True)
        return np.array(torque), np.array(ideal)


def _beside(one: ca.Function, other: ca.Function) -> ca.Function:
    given = one.sx_in()
    return ca.Function(one.name(), given, [*one.call(given), *other.call(given)])
