"""A robot as a log has it: its base held still, only those limbs that the log knows."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from ce_gym.dynamics.model import Model
from ce_gym.model.description import Body, Pose, Robot
from ce_gym.model.errors import RobotError, unknown_name
from ce_gym.model.formats.placement import compose
from ce_gym.model.frames import Placement
from ce_gym.model.mechanism import ELASTIC, LEVELS


def held_model(robot: Robot, names: Collection[str], transmission: str) -> Model:
    """Return the model of a robot that hangs in the air.

    Args:
        robot: The robot.
        names: As for `held`.
        transmission: Level of the simulation.

    Raises:
        RobotError: There is no such level, or a joint turns about all axes.
    """
    if transmission not in (levels := (*LEVELS, ELASTIC)):
        raise unknown_name("identify", "transmission", transmission, levels, "a transmission level")
    model = Model(held(robot, names), transmission)
    if model.nq != model.nv:
        raise RobotError(f"{robot.name}: identify: expected joints about or along one axis, no ball joints")
    return model


def held(robot: Robot, names: Collection[str]) -> Robot:
    """Return a robot that hangs in the air, its base held upright: no contact, and those limbs that are named.

    Args:
        robot: The robot, with a floating base or a fixed one.
        names: Bodies of limbs; a limb is all that moves together once the base is held.
    """
    bodies = _on_the_world(robot.bodies) if robot.floating else robot.bodies
    limbs = limbs_of(replace(robot, bodies=bodies))
    there = {limbs[name] for name in names if name in limbs}
    kept = {body.name for body in bodies if limbs[body.name] in there}
    gains = {key: tuple(pair for pair in getattr(robot.gains, key) if pair[0] in kept) for key in ("kp", "kd")}
    return replace(
        robot,
        bodies=tuple(body for body in bodies if body.name in kept),
        constraints=tuple(tie for tie in robot.constraints if set(tie.bodies) <= kept),
        independent=tuple(name for name in robot.independent if name in kept),
        contacts=(),
        capsules=(),
        self_collisions=(),
        motors=tuple(motor for motor in robot.motors if motor.rotor in kept),
        elastic=tuple(elastic for elastic in robot.elastic if elastic.rotor in kept),
        pose=Pose(0.0, tuple(p for p in robot.pose.joints if p[0] in kept), robot.pose.balls),
        gains=replace(robot.gains, **gains),
        assembly=tuple(pair for pair in robot.assembly if pair[0] in kept),
        tasks=(),
    )


def limbs_of(robot: Robot) -> dict[str, int]:
    """Return a number for each body, the same for those that move together: by their parents or by what ties them."""
    limb = {body.name: i for i, body in enumerate(robot.bodies)}
    together = [(body.name, body.parent) for body in robot.bodies if body.parent is not None]
    together += [(tie.bodies[0], name) for tie in robot.constraints for name in tie.bodies[1:]]
    for a, b in together:
        old, new = limb[a], limb[b]
        limb = {name: new if i == old else i for name, i in limb.items()}
    return limb


def _on_the_world(bodies: tuple[Body, ...]) -> tuple[Body, ...]:
    """Leave out a floating base; what it carried is on the world, as if the base were upright at the origin."""
    base = bodies[0]
    return tuple(
        replace(
            body, parent=None, placement=compose(Placement((0.0, 0.0, 0.0), base.placement.rotation), body.placement)
        )
        if body.parent == base.name
        else body
        for body in bodies[1:]
    )
