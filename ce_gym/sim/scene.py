"""Scene options resolved for one robot: names of contacts and pairs of links, material, and the kind of ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

from ce_gym.dynamics.forces.scene import Control, JointControl, SceneOptions, StepOptions
from ce_gym.dynamics.forces.self_collision import apart_when_standing
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.model import Model
from ce_gym.model import ContactMaterial, Robot
from ce_gym.model.arguments import check, check_choice
from ce_gym.model.checks.collisions import adjacent, capsules_of, colliding
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism
from ce_gym.sim.terrain import Terrain
from ce_gym.sim.terrain.hulls import hulls_on

MOST_PAIRS = 32
"""Most pairs of capsules in a scene, because the system of their forces is dense."""


def resolve_scene(
    scene: SceneOptions,
    model: Model,
    terrain: Terrain | None,
    control: str,
    parameters: Sequence[str] = (),
    material: ContactMaterial | None = None,
    joint_control: Sequence[tuple[str, JointControl]] = (),
) -> StepOptions:
    """Return the options of the sub-steps of one robot.

    Args:
        scene: The scene options.
        model: The robot at a transmission level.
        terrain: The ground; the plane z = 0 if None.
        control: Meaning of targets, see `ce_gym.Simulator`.
        parameters: Names of parameters that can differ from robot to robot.
        material: Compliance and friction of the contacts; the robot's own if None.
        joint_control: See `StepOptions`.

    Raises:
        ValueError: If the robot lacks a contact or link, or its controllers cannot be sampled.
    """
    check_choice("control", control, get_args(Control))
    contacts = select_contacts(model.robot, scene.contacts)
    resolved = {
        "dt": None,  # kernels read both from buffers
        "tolerance": None,
        "contacts": contacts,
        "self_collisions": select_pairs(model.mechanism, scene.self_collisions),
        "ground": "field" if terrain is not None and contacts else "flat",
        "hulls": hulls_on(model.robot, contacts, terrain),
    }
    material = model.robot.material if material is None else material
    given = {"control": control, "joint_control": tuple(joint_control), "parameters": tuple(parameters)}
    options = StepOptions(**scene.shared | resolved | given, material=material)
    period, samples = scene.control_period, control.endswith("position") and not METHODS[scene.method].controlled
    check("control_period", period, period == 0 or samples, "0, but for control of positions in steps of one length")
    return options


def select_contacts(robot: Robot, contacts: str | Sequence[str]) -> tuple[str, ...]:
    """Return names of contact spheres, in the robot's order.

    Args:
        robot: The robot.
        contacts: "all", or names of spheres or groups of spheres, one or several.

    Raises:
        ValueError: If a name is not a sphere or a group, or is listed twice.
    """
    names = [contacts] if isinstance(contacts, str) else list(contacts)
    known = sorted({c.group for c in robot.contacts} | {c.name for c in robot.contacts})
    listed = [name for name in names if name != "all"]
    check_names("contacts", listed, known, "'all', groups or names among")
    wanted = set(names)
    return tuple(c.name for c in robot.contacts if wanted & {"all", c.group, c.name})


def select_pairs(mechanism: Mechanism, pairs: str | Sequence[Sequence[str]]) -> tuple[tuple[str, str], ...]:
    """Return pairs of links that push each other apart, each of which has a capsule.

    Args:
        mechanism: The robot.
        pairs: "listed", "all", or pairs of names.

    Raises:
        ValueError: If a link does not exist or has no capsule, or the choice is unknown.
    """
    robot = mechanism.robot
    if isinstance(pairs, str) and pairs not in ("listed", "all"):
        raise ValueError(f"self_collisions={pairs!r}; expected 'listed', 'all', or pairs of names of links")
    everything = apart_when_standing(mechanism) if pairs == "all" else robot.self_collisions
    chosen = everything if isinstance(pairs, str) else tuple(tuple(pair) for pair in pairs)
    known = [body.name for body in robot.bodies if body.kind == "link" and capsules_of(robot, body.name)]
    for pair in chosen:
        if len(pair) != 2:
            raise ValueError(f"self_collisions: {pair!r}; expected two links")
        check_names("self_collisions", pair, known, "a link with capsules among")
        if adjacent(*map(robot.body, pair)):
            raise ValueError(f"self_collisions: {pair!r}; expected two links of which none carries the other")
    unordered = [" and ".join(sorted(pair)) for pair in chosen]
    check_names("self_collisions", unordered, unordered, "a pair of links among")
    if (count := len(colliding(robot, chosen))) > MOST_PAIRS:  # type: ignore[arg-type]
        raise ValueError(
            f"self_collisions: {count} pairs of capsules; expected at most {MOST_PAIRS}, name those that matter"
        )
    return chosen  # type: ignore[return-value]
