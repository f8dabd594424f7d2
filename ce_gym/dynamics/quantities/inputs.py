"""The inputs of traced quantities: positions, velocities, and guesses of dependent positions."""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.closure import reference_guess
from ce_gym.model.mechanism import Mechanism


def state_symbols(mechanism: Mechanism) -> tuple[SX, SX, SX]:
    """Return fresh symbols for positions (nq,), velocities (nv,) and guesses of dependent positions (n_guess,)."""
    layout = mechanism.robot.layout
    q, v = SX.sym("q", layout.nq), SX.sym("v", layout.nv)
    return q, v, SX.sym("guess", len(reference_guess(mechanism)))


def function_of_state(name: str, guess: SX, inputs: dict[str, SX], outputs: dict[str, SX]) -> ca.Function:
    """Trace a function that has an input `guess` only if the robot needs one."""
    return traced(name, inputs | ({"guess": guess} if guess.numel() else {}), outputs)
