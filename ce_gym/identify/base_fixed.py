"""The robot of a log: with a fixed base, and only the limbs in the log."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from ce_gym.dynamics.model import Model
from ce_gym.model.description import Body, Pose, Robot
from ce_gym.model.errors import file_error, unknown_name
from ce_gym.model.formats.placement import compose
from ce_gym.model.frames import Placement
from ce_gym.model.mechanism import ELASTIC, LEVELS


def base_fixed_model(robot: Robot, names: Collection[str], transmission: str) -> Model:
    """Return the model of some limbs of a robot with a fixed base.

    Args:
        robot: The robot.
        names: Bodies of the limbs, see `fix_base`.
        transmission: Transmission level.

    Raises:
        RobotError: There is no such level, or the limbs have ball joints.
    """
    if transmission not in (levels := (*LEVELS, ELASTIC)):
        raise unknown_name("identify", "transmission", transmission, levels, "a transmission level")
    model = Model(fix_base(robot, names), transmission)
    if model.nq != model.nv:
        raise file_error(robot.name, "identify: the robot has ball joints", "joints about or along one axis")
    return model


def fix_base(robot: Robot, names: Collection[str]) -> Robot:
    """Return some limbs of a robot with a fixed, upright base and without contacts.

    Args:
        robot: The robot, with a floating or a fixed base.
        names: Bodies of the limbs; a limb is a set of bodies that move together if the base is fixed.
    """
    bodies = _without_base(robot.bodies) if robot.floating else robot.bodies
    limbs = limbs_of(replace(robot, bodies=bodies))
    chosen = {limbs[name] for name in names if name in limbs}
    kept = {body.name for body in bodies if limbs[body.name] in chosen}
    gains = {key: tuple(pair for pair in getattr(robot.gains, key) if pair[0] in kept) for key in ("kp", "kd")}
    return replace(
        robot,
        bodies=tuple(body for body in bodies if body.name in kept),
        constraints=tuple(tie for tie in robot.constraints if set(tie.bodies) <= kept),
        independent=tuple(name for name in robot.independent if name in kept),
        contacts=(),
        capsules=(),
        frames=tuple(frame for frame in robot.frames if frame.body in kept),
        self_collisions=(),
        motors=tuple(motor for motor in robot.motors if motor.rotor in kept),
        elastic=tuple(elastic for elastic in robot.elastic if elastic.rotor in kept),
        pose=Pose(0.0, tuple(p for p in robot.pose.joints if p[0] in kept), robot.pose.balls),
        gains=replace(robot.gains, **gains),
        assembly=tuple(pair for pair in robot.assembly if pair[0] in kept),
        tasks=(),
    )


def limbs_of(robot: Robot) -> dict[str, int]:
    """Return the number of each body's limb, by body; bodies with a common ancestor or constraint share a limb."""
    limb = {body.name: i for i, body in enumerate(robot.bodies)}
    connected = [(body.name, body.parent) for body in robot.bodies if body.parent is not None]
    connected += [(tie.bodies[0], name) for tie in robot.constraints for name in tie.bodies[1:]]
    for a, b in connected:
        old, new = limb[a], limb[b]
        limb = {name: new if i == old else i for name, i in limb.items()}
    return limb


def _without_base(bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Remove the floating base, the first body; attach its children to the world, as to a base at the origin."""
    base = bodies[0]
    upright = Placement((0.0, 0.0, 0.0), base.placement.rotation)
    return tuple(
        replace(body, parent=None, placement=compose(upright, body.placement)) if body.parent == base.name else body
        for body in bodies[1:]
    )
