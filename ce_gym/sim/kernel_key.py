"""What the program of a simulator's kernel depends on, beside its options: the model, and the sources that trace it."""

from dataclasses import replace

from ce_gym.compile import source_fingerprint
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.residuals import residual
from ce_gym.dynamics.functions import traced
from ce_gym.dynamics.model import Model
from ce_gym.model import FunctionConstraint, Robot

SOURCES = ("ce_gym.model", "ce_gym.dynamics", "ce_gym.sim")
"""What traces a model and makes programs of it."""


def model_key(model: Model) -> str:
    """Return a text that is equal for equal models, for cache keys; where a robot was read from does not matter."""
    robot = replace(model.robot, source="", notes=(), tasks=())
    options = f"{model.transmission} {model.locked_rotors} {model.eliminated}"
    return f"{source_fingerprint(*SOURCES)} {robot!r} {options} {_functions(robot)}"


def _functions(robot: Robot) -> list[str]:
    """Return what users' constraint functions compute, of which a description has only the names."""
    q = SX.sym("q", len(robot.bodies))
    angles = {body.name: q[i] for i, body in enumerate(robot.bodies)}
    ties = [tie for tie in robot.constraints if isinstance(tie, FunctionConstraint)]
    return [traced("tie", {"q": q}, {"residual": residual(robot, tie, angles)}).serialize() for tie in ties]
