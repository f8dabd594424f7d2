"""Every parameter, declared for a robot at a level in a scene, either changes a step or is refused; nothing between."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from linkages import rod_leg
from tripod import TRIPOD

from ce_gym import Simulator
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.scene import StepOptions, target_names
from ce_gym.dynamics.laws.scene_laws import PARAMETERS, state_sizes
from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
from ce_gym.dynamics.parameter_effects import check_effects
from ce_gym.dynamics.stepping.trace import step_function
from ce_gym.model import Battery, Elasticity, Heat, Robot, load_robot
from ce_gym.model.drives import ELASTIC_FACTORS, DriveFriction

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

ADDED = ("com_shift", "added_mass", "joint_damping", "joint_friction", "motor_damping", "motor_friction")
"""Parameters that may be 0, where a factor would change nothing."""
TILTED = ((4e-5, 5e-6, 3e-6), (5e-6, 5e-5, -4e-6), (3e-6, -4e-6, 3e-5))


def plain() -> Robot:
    return load_robot(TRIPOD)


def rich() -> Robot:
    """A robot that has everything; one of its rotors is a body of the recursion at the exact level."""
    robot = load_robot(TRIPOD)
    heat = Heat(2.0, 20.0, 1.5, 3.0, warm=30.1, ambient=30.0)
    drive = DriveFriction(stribeck=0.05, stribeck_speed=5.0, load_motor=0.1)
    figures = {"motor_constant": 0.1, "heat": heat, "cogging": ((6, 0.02, 0.3),), "drive_friction": drive}
    first, *_ = robot.rotors()
    lopsided = replace(first, inertial=replace(first.inertial, inertia=TILTED))
    return replace(
        robot,
        bodies=tuple(lopsided if body is first else body for body in robot.bodies),
        motors=tuple(replace(motor, **figures) for motor in robot.motors),
        elastic=tuple(Elasticity(rotor.name, 20.0, damping=0.01, backlash=0.02) for rotor in robot.rotors()),
        battery=Battery(20.0, 0.4, 24.0, idle=12.0),
    )


CASES = [
    *((rich, level, motors, "position") for level in ("elastic", "exact", "none") for motors in ("ideal", "limited")),
    *((rich, level, "limited", "motor_torque") for level in ("coupled", "armature", "none")),
    *((plain, level, motors, "torque") for level, motors in (("exact", "limited"), ("none", "ideal"))),
    *((rod_leg, level, "ideal", "torque") for level in ("exact", "coupled", "armature")),
]


def names_of(robot: Robot) -> list[str]:
    """Return all parameters that a robot's names allow."""
    owners = {"BODY": [body.name for body in robot.bodies if body.kind == "link"]}
    found = []
    for name in PARAMETERS:
        kind, _, owner = name.partition(":")
        rotors = [e.rotor for e in robot.elastic] if kind in ELASTIC_FACTORS else [r.name for r in robot.rotors()]
        found += [f"{kind}:{x}" for x in (owners | {"ROTOR": rotors})[owner]] if owner else [name]
    return found


def changing(model: Model, options: StepOptions) -> set[str]:
    """Return the parameters whose change changes one of a few steps: on the feet, motors at their limits or not."""
    robot, defaults = model.robot, parameter_defaults(model.robot, options.material, options.parameters)
    step, sizes = step_function(model.mechanism, options), state_sizes(model.mechanism, options)
    rng, found, joints = np.random.default_rng(0), set(), robot.layout.joints
    n = len(target_names(model.mechanism, options.control))
    for spread in (0.05, 2.0, 40.0):
        q = model.standing_q + np.r_[np.zeros(model.nq - joints), rng.normal(0, 0.03, joints)]
        q[2] -= 0.004
        state = {name: np.abs(rng.normal(0, 0.3, size)) for name, size in sizes.items()}
        state |= {"q": q, "v": rng.normal(0, 0.5, model.nv), "load": rng.uniform(5, 40, sizes.get("load", 0))}
        if "motor_warmth" in sizes:
            state["motor_warmth"] = rng.uniform(20, 60, sizes["motor_warmth"])
        if "dependent" in sizes:
            state["dependent"] = model.dependent_guess(q)
        state = {name: state[name] for name in sizes}
        here = q[-joints:][:n] if options.control == "position" else 0.0
        given = {"diverged": 0.0, "target": here + rng.normal(0, spread, n)}
        nominal = step(**state, **given, parameters=np.concatenate(list(defaults.values())))
        for name in set(options.parameters) - found:
            value = defaults[name] + 0.01 if name.split(":")[0] in ADDED else 1.3 * defaults[name]
            values = np.concatenate([value if x == name else default for x, default in defaults.items()])
            changed = step(**state, **given, parameters=values)
            if any(np.abs((changed[x] - nominal[x]).full()).max() > 1e-10 for x in map("{}_next".format, sizes)):
                found.add(name)
    return found


@pytest.mark.parametrize(("make", "level", "motors", "control"), CASES)
def test_a_parameter_acts_or_is_refused(make, level: str, motors: str, control: str):
    robot = make()
    model, names = Model(robot, level), tuple(names_of(robot))
    feet = tuple(contact.name for contact in robot.contacts if contact.group == "foot")
    options = StepOptions(
        0.004, control=control, contacts=feet, material=robot.material, motors=motors, parameters=names
    )  # type: ignore[arg-type]
    accepted = set()
    for name in names:
        with suppress(ValueError):
            check_effects(model.mechanism, replace(options, parameters=(name,)))
            accepted.add(name)
    assert accepted == changing(model, options)


def test_simulators_refuse_what_has_no_effect():
    with pytest.raises(ValueError, match="'drive_stiffness' has no effect on mini_cheetah; expected transmission"):
        Simulator(Model("mini_cheetah"), parameters=("drive_stiffness",))
    with pytest.raises(ValueError, match="'motor_friction' has no effect on tripod; expected motors='limited'"):
        Simulator(Model(TRIPOD), parameters=("motor_friction",))
