# pyright: reportAttributeAccessIssue=false
"""Robots in Pinocchio: the tree of a robot with armature, because `aba` has no loops and no gears.

Pinocchio's `crba` returns wrong results without an error if joints are not numbered depth first. Its base velocity is
[linear, angular] and its quaternion (x, y, z, w); ce_gym has the opposite order.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin  # type: ignore[import-not-found]
from numpy.typing import NDArray

from ce_gym.bench.measure.timing import Competitor
from ce_gym.export.joint_ties import joint_ties
from ce_gym.export.mjcf import mass_properties
from ce_gym.export.mjcf_equalities import joint_armature
from ce_gym.model.constraints import LinearConstraint
from ce_gym.model.description import Robot
from ce_gym.model.errors import RobotError
from ce_gym.model.mechanism import Mechanism, build_mechanism

Array = NDArray[np.float64]
Call = Callable[[], object]

AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class Peer:
    """A robot in Pinocchio.

    Attributes:
        robot: The robot in ce_gym.
        model: The robot in Pinocchio, with armature.
        names: Name of the body of each joint, in Pinocchio's order.
    """

    robot: Robot
    model: pin.Model
    names: tuple[str, ...]

    def positions(self, q: Array) -> Array:
        """Convert positions to Pinocchio's order, shape (nq,) to (model.nq,)."""
        base = 7 if self.robot.floating else 0
        joints = dict(zip(self.robot.independent, q[base:], strict=True))
        head = [*q[:3], *q[4:7], q[3]] if base else []
        return np.array([*head, *(joints[name] for name in self.names if name in joints)])

    def velocities(self, v: Array) -> Array:
        """Convert velocities or forces to Pinocchio's order, shape (nv,) to (model.nv,)."""
        base = 6 if self.robot.floating else 0
        joints = dict(zip(self.robot.independent, v[base:], strict=True))
        return np.array([*v[3:base], *v[: min(3, base)], *(joints[name] for name in self.names if name in joints)])

    def accelerations(self, a: Array) -> Array:
        """Convert accelerations from Pinocchio's order, shape (model.nv,) to (nv,)."""
        base = 6 if self.robot.floating else 0
        names = self.names[1:] if base else self.names
        joints = dict(zip(names, a[base:], strict=True))
        return np.array([*a[3:base], *a[: min(3, base)], *(joints[name] for name in self.robot.independent)])


def load(robot: Robot) -> Peer:
    """Return a robot at transmission level `armature`.

    Raises:
        RobotError: If the robot has an element that Pinocchio's forward dynamics lacks.
    """
    if robot.balls:
        raise RobotError(f"{robot.name}: ball joint of {robot.balls[0]!r}: expected none for this comparison")
    mechanism = build_mechanism(robot, "armature", eliminate=False)
    ties = joint_ties(mechanism)
    for constraint in robot.constraints:
        moving = [body for body in constraint.bodies if body in mechanism.bodies]
        if not isinstance(constraint, LinearConstraint) or len(moving) == len(constraint.bodies):
            raise RobotError(f"{robot.name}: constraint {constraint.name!r} ties joints, which aba does not know")
    model, names = _tree(mechanism, joint_armature(mechanism, ties))
    return Peer(robot, model, names)


def forward_dynamics(peer: Peer, n_states: int = 64) -> Competitor:
    """Return `aba` called from a Python loop on standing states with random velocities and forces."""
    model, data = peer.model, peer.model.createData()
    return Competitor(_loop(lambda q, v, tau: pin.aba(model, data, q, v, tau), _states(peer, n_states)), n_states)


def derivatives(peer: Peer, n_states: int = 64) -> Competitor:
    """Return `computeABADerivatives` called from a Python loop on standing states with random velocities and forces."""
    model, data = peer.model, peer.model.createData()
    call = _loop(lambda q, v, tau: pin.computeABADerivatives(model, data, q, v, tau), _states(peer, n_states))
    return Competitor(call, n_states)


def _states(peer: Peer, n_states: int) -> list[tuple[Array, Array, Array]]:
    rng = np.random.default_rng(0)
    pose, nv = dict(peer.robot.pose.joints), peer.model.nv
    base = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0] if peer.robot.floating else []
    q = peer.positions(np.array([*base, *(pose.get(name, 0.0) for name in peer.robot.independent)]))
    return [(q, rng.uniform(-2, 2, nv), rng.uniform(-10, 10, nv)) for _ in range(n_states)]


def overhead(n_calls: int = 64) -> Competitor:
    """Return `aba` of a single joint called from a Python loop, to measure the overhead of a call."""
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRX(), pin.SE3.Identity(), "x")
    model.appendBodyToJoint(joint, pin.Inertia(1.0, np.zeros(3), np.eye(3)), pin.SE3.Identity())
    data = model.createData()
    states = [(np.zeros(1), np.zeros(1), np.zeros(1))] * n_calls
    return Competitor(_loop(lambda q, v, tau: pin.aba(model, data, q, v, tau), states), n_calls)


def _loop(method: Callable[[Array, Array, Array], object], states: list[tuple[Array, Array, Array]]) -> Call:
    def run() -> None:
        for state in states:
            method(*state)

    return run


def _tree(mechanism: Mechanism, armature: dict[str, float]) -> tuple[pin.Model, tuple[str, ...]]:
    """Return the tree with joints numbered depth first, and the names of the bodies."""
    model, names = pin.Model(), []
    ids: dict[str | None, int] = {None: 0}
    model.gravity.linear = np.array(mechanism.robot.gravity)
    children: dict[str | None, list[str]] = {}
    for body in mechanism.bodies.values():
        children.setdefault(body.parent, []).append(body.name)
    waiting = children[None][::-1]
    while waiting:
        body = mechanism.bodies[waiting.pop()]
        waiting += children.get(body.name, [])[::-1]
        placement = pin.SE3(np.array(body.rotation), np.array(body.position))
        ids[body.name] = model.addJoint(ids[body.parent], _joint(body.joint.type, body.axis), placement, body.name)
        mass, com, inertia = mass_properties(body.inertia)
        model.appendBodyToJoint(ids[body.name], pin.Inertia(mass, com, inertia), pin.SE3.Identity())
        if body.name in armature:
            all_armature = np.array(model.armature)
            all_armature[model.joints[ids[body.name]].idx_v] = armature[body.name]
            model.armature = all_armature
        names.append(body.name)
    return model, tuple(names)


def _joint(kind: str, axis: Array) -> pin.JointModel:
    if kind == "free":
        return pin.JointModelFreeFlyer()
    family = {"revolute": "R", "prismatic": "P"}[kind]
    for i, letter in enumerate(AXES):  # joints along a coordinate axis are faster
        if np.allclose(axis, np.eye(3)[i]):
            return getattr(pin, f"JointModel{family}{letter}")()
    return getattr(pin, {"R": "JointModelRevoluteUnaligned", "P": "JointModelPrismaticUnaligned"}[family])(axis)
