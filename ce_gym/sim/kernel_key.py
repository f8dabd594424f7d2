"""Keys of kernels in the cache: texts for the model, the sources that trace the model, and the force laws."""

from dataclasses import replace

from ce_gym.compile import source_fingerprint
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.constraints.residuals import residual
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.motors import MOTORS
from ce_gym.dynamics.forces.normal import normal_law
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.scene_laws import scene_laws
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.trace import iteration_function
from ce_gym.model import FunctionConstraint, Robot
from ce_gym.model.mechanism import Mechanism

SOURCES = ("ce_gym.model", "ce_gym.dynamics", "ce_gym.sim")
"""Packages that trace a model and make programs."""


def model_key(model: Model) -> str:
    """Return a text that is equal for equal models, for cache keys; the file of the robot does not matter."""
    robot = replace(model.robot, source="", notes=(), tasks=())
    options = f"{model.transmission} {model.locked_rotors} {model.eliminate_rotors}"
    return f"{source_fingerprint(*SOURCES)} {robot!r} {options} {_functions(robot)}"


def laws_key(mechanism: Mechanism, options: StepOptions) -> str:
    """Return a text that is equal for equal methods and laws, for cache keys; laws of users are traced for that."""
    laws = normal_law(options.normal_law, options.material), FRICTION[options.friction], MOTORS[options.motors]
    laws = *laws, *scene_laws(mechanism, options)
    ours = all(type(law).__module__.startswith("ce_gym.") for law in laws)
    traced_laws = "" if ours else iteration_function(mechanism, options).serialize()
    return f"{METHODS[options.method]!r} {traced_laws}"


def _functions(robot: Robot) -> list[str]:
    """Return the traced constraint functions of users, of which a description has only the names."""
    q = SX.sym("q", len(robot.bodies))
    angles = {body.name: q[i] for i, body in enumerate(robot.bodies)}
    ties = [tie for tie in robot.constraints if isinstance(tie, FunctionConstraint)]
    return [traced("tie", {"q": q}, {"residual": residual(robot, tie, angles)}).serialize() for tie in ties]
