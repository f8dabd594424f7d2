"""Scene options resolved for one robot: names of contacts and pairs of links, material, and the kind of ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

from ce_gym.dynamics.forces.scene import Control, SceneOptions, StepOptions
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.model import Model
from ce_gym.model import ContactMaterial
from ce_gym.model.arguments import check, check_choice
from ce_gym.sim.kernels import select_contacts, select_pairs
from ce_gym.sim.terrain import Terrain
from ce_gym.sim.terrain.hulls import hulls_on


def resolve_scene(
    scene: SceneOptions,
    model: Model,
    terrain: Terrain | None,
    control: str,
    parameters: Sequence[str] = (),
    material: ContactMaterial | None = None,
) -> StepOptions:
    """Return the options of the sub-steps of one robot.

    Args:
        scene: The scene options.
        model: The robot at a transmission level.
        terrain: The ground; the plane z = 0 if None.
        control: Meaning of targets, see `ce_gym.Simulator`.
        parameters: Names of parameters that can differ from robot to robot.
        material: Compliance and friction of the contacts; the robot's own if None.

    Raises:
        ValueError: If the robot lacks a contact or link, or its controllers cannot be sampled.
    """
    check_choice("control", control, get_args(Control))
    contacts = select_contacts(model.robot, scene.contacts)
    seldom = select_contacts(model.robot, scene.seldom, "seldom")
    resolved = {
        "dt": None,  # kernels read both from buffers
        "tolerance": None,
        "contacts": contacts,
        "seldom": tuple(name for name in seldom if name in contacts),
        "self_collisions": select_pairs(model.mechanism, scene.self_collisions),
        "ground": "field" if terrain is not None and contacts else "flat",
        "hulls": hulls_on(model.robot, contacts, terrain),
    }
    given = {"control": control, "parameters": tuple(parameters), "material": material or model.robot.material}
    options = StepOptions(**scene.shared | resolved | given)
    period, samples = scene.control_period, control.endswith("position") and not METHODS[scene.method].controlled
    check("control_period", period, period == 0 or samples, "0, but for control of positions in steps of one length")
    return options
