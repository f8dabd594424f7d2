"""The force laws of a scene, in the order in which they are added, and what follows from their declarations."""

from __future__ import annotations

from typing import Literal

from ce_gym.dynamics.constraints.closure import reference_guess
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.laws.contacts import Contacts
from ce_gym.dynamics.laws.drive_meshes import DriveMeshes
from ce_gym.dynamics.laws.joint_friction import DryJointFriction
from ce_gym.dynamics.laws.joint_springs import JointSprings
from ce_gym.dynamics.laws.joint_stops import JointStops
from ce_gym.dynamics.laws.law import ForceLaw
from ce_gym.dynamics.laws.link_pairs import LinkPairs
from ce_gym.dynamics.laws.motor_drives import MotorDrives
from ce_gym.dynamics.parameters import MODEL_PARAMETERS, Parameter
from ce_gym.dynamics.state import Field, Output, State
from ce_gym.model.mechanism import Mechanism

LAWS: list[type[ForceLaw]] = []
"""All force laws. Sums of forces follow this order.

`DriveMeshes` is the last, because the response of a stretch depends on the slopes of all other forces.
"""


STEP_OUTPUTS = (
    Output("energy", "J", "kinetic, potential and elastic energy, see `mechanical_energy`"),
    Output("error", "rad/s or m/s", "estimated error of the step in the velocities, of methods that have one"),
    Output("loop_gap", "m or -", "norm of the residuals of the closed loops", "start"),
    Output("nearness", "-", "distance from a singularity, see `Model.nearness`", "start"),
)
OUTPUTS: dict[str, Output] = {}
"""All outputs that a step can report on request, by name."""
PARAMETERS: dict[str, Parameter] = {parameter.name: parameter for parameter in MODEL_PARAMETERS}
"""All parameters by name; BODY stands for the name of a link, ROTOR for that of a rotor."""


def add_law(law: type[ForceLaw]) -> None:
    """Add a force law, with its outputs and parameters, to all scenes in which it acts."""
    LAWS.insert(len(LAWS) - (DriveMeshes in LAWS), law)
    OUTPUTS.update({output.name: output for output in law.outputs})
    PARAMETERS.update({parameter.name: parameter for parameter in law.parameters})


for _law in (Contacts, LinkPairs, MotorDrives, JointStops, DryJointFriction, JointSprings, DriveMeshes):
    add_law(_law)
OUTPUTS.update({output.name: output for output in STEP_OUTPUTS})


def scene_laws(mechanism: Mechanism, options: StepOptions) -> list[ForceLaw]:
    """Return the laws of the forces that a scene has."""
    laws = [law(mechanism, options) for law in LAWS]
    return [law for law in laws if law.acts]


def state_fields(mechanism: Mechanism, options: StepOptions) -> tuple[Field, ...]:
    """Return the parts of the state of a robot in a scene, those that are empty left out."""
    layout = mechanism.robot.layout
    fields = [
        Field("q", layout.nq, "rad or m", "positions", explicit=True),
        Field("v", layout.nv, "rad/s or m/s", "velocities", explicit=True),
        Field("dependent", len(reference_guess(mechanism)), "rad or m", "guess of loop coordinates", explicit=True),
    ]
    fields += [field for law in scene_laws(mechanism, options) for field in law.fields]
    return tuple(field for field in fields if field.size)


def state_sizes(mechanism: Mechanism, options: StepOptions) -> dict[str, int]:
    """Return the sizes of the parts of the state by name."""
    return {field.name: field.size for field in state_fields(mechanism, options)}


def symbolic_state(mechanism: Mechanism, options: StepOptions) -> State:
    """Return a state of fresh symbols."""
    return State.symbolic(state_fields(mechanism, options))


def output_sizes(mechanism: Mechanism, options: StepOptions) -> dict[str, int]:
    """Return the sizes of the outputs of all laws by name, for a scene with or without their forces."""
    return {name: size for law in LAWS for name, size in law(mechanism, options).output_sizes.items()}


def moment_of(name: str) -> Literal["start", "end", "mean"]:
    """Return the moment that an output belongs to; the end of the step for results that are no outputs."""
    return OUTPUTS[name].of if name in OUTPUTS else "end"


def iterate_size(mechanism: Mechanism, options: StepOptions) -> int:
    """Return the size of the iterate of a step: the iterates of all laws, stacked."""
    return sum(law.size for law in scene_laws(mechanism, options))


def iterations_needed(mechanism: Mechanism, options: StepOptions) -> int:
    """Return how many iterations of a step may follow the first."""
    return max((law.iterations for law in scene_laws(mechanism, options)), default=0)


def culled_rows(mechanism: Mechanism, options: StepOptions) -> list[list[int]]:
    """Return the rows of the iterate of each culled group, in the order of `step.cull`."""
    groups, first = [], 0
    for law in scene_laws(mechanism, options):
        groups += [[first + row for row in rows] for rows in law.culled_rows.values()]
        first += law.size
    return groups
