"""Robot files of a folder beside MuJoCo (MJCF) or Pinocchio (URDF): mass, mass matrix and accelerations at `armature`.

Files with tied joints or loops load but are not compared, since the peers solve those softly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model import Robot, RobotError, load_robot
from ce_gym.model.formats.mjcf.balls import balls_in_loops
from ce_gym.model.formats.mjcf.bodies import read_bodies
from ce_gym.model.formats.mjcf.equalities import locked_joints
from ce_gym.model.formats.mjcf.source import read_mjcf

Array = NDArray[np.float64]
Dynamics = tuple[float, Array, Array]  # total mass [kg], mass matrix, acceleration, both in our coordinates

TOLERANCE = 1e-9
"""Of differences relative to the peer's largest figure."""


@dataclass(frozen=True)
class Outcome:
    """What became of a file.

    Attributes:
        text: "same", "DIFFERS", "loads" if nothing was compared, or why the file was refused.
        joints: Number of independent joints, if it loads.
        errors: Of mass, mass matrix and acceleration, relative; empty if nothing was compared.
    """

    text: str
    joints: int | None = None
    errors: tuple[float, ...] = ()


def files(folder: Path) -> Iterator[Path]:
    """Iterate over files that describe a robot: URDF, and MJCF with a body that moves."""
    for path in sorted(folder.rglob("*.urdf")) + sorted(folder.rglob("*.xml")):
        text = path.read_text(encoding="utf-8", errors="replace")
        if path.suffix == ".urdf" or ("<mujoco" in text and "joint" in text and "<body" in text):
            yield path


def outcome(path: Path) -> Outcome:
    """Load a file and compare it with its peer in a random state."""
    try:
        robot = load_robot(path)
        model = Model(robot, "armature")
    except RobotError as error:
        return Outcome(str(error).removeprefix(f"{path}: "))
    joints = len(robot.independent)
    if any(not _is_gear(robot, tie.name) for tie in robot.constraints):
        return Outcome("loads", joints)
    q, v, tau = _state(model)
    try:
        theirs = (_pinocchio if path.suffix == ".urdf" else _mujoco)(path, robot, q, v, tau)
    except Exception as error:  # a peer that cannot read the file
        return Outcome(f"loads; no peer ({type(error).__name__})", joints)
    ours = (robot.total_mass, model.mass_matrix(q), model.forward_dynamics(q, v, tau))
    errors = tuple(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(ours, theirs, strict=True))
    return Outcome("same" if max(errors) <= TOLERANCE else "DIFFERS", joints, errors)


def _is_gear(robot: Robot, tie: str) -> bool:
    """Whether a constraint belongs to a rotor that the reader has made from armature."""
    return any(rotor.name == tie and rotor.inertial.mass == 0.0 for rotor in robot.rotors())


def _state(model: Model) -> tuple[Array, Array, Array]:
    """Return a random state and torque; a floating base is turned and moves."""
    rng, robot = np.random.default_rng(0), model.robot
    q = model.standing_q.copy()
    q[robot.layout.joints_q :] += rng.uniform(-0.3, 0.3, len(robot.independent))
    for row, _ in robot.layout.turns:
        q[row : row + 4] = rng.normal(size=4)
        q[row : row + 4] /= np.linalg.norm(q[row : row + 4])
    return q, rng.uniform(-1, 1, model.nv), rng.uniform(-5, 5, model.nv)


def _mujoco(path: Path, robot: Robot, q: Array, v: Array, tau: Array) -> Dynamics:
    import mujoco

    mj = mujoco.MjModel.from_xml_path(str(path))
    mj.dof_armature[: robot.layout.base_nv] = 0.0  # of the base, by a default meant for joints: listed as left out
    data, free, rotation = mujoco.MjData(mj), robot.layout.base_nv, np.zeros(9)
    mujoco.mju_quat2Mat(rotation, q[3:7] if free else np.array([1.0, 0.0, 0.0, 0.0]))
    to_theirs = np.zeros((mj.nv, len(v)))  # their velocity of ours: [linear in the world, angular in the body, joints]
    data.qpos[: robot.layout.base_nq] = q[: robot.layout.base_nq]
    if free:
        to_theirs[:3, 3:6], to_theirs[3:6, :3] = rotation.reshape(3, 3), np.eye(3)
    source = read_mjcf(path)
    locked = locked_joints(source)
    for j, position in locked.items():
        data.qpos[mj.jnt_qposadr[j]] = position
    for j, body in read_bodies(source, locked, balls_in_loops(source)).moved_by.items():
        if mj.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE:
            (rows, speeds), at, dof = robot.rows[body], mj.jnt_qposadr[j], mj.jnt_dofadr[j]
            data.qpos[at : at + len(rows)] = q[rows.start : rows.stop]
            to_theirs[dof + np.arange(len(speeds)), speeds] = 1.0
    data.qvel[:] = to_theirs @ v
    mujoco.mj_forward(mj, data)
    M = np.zeros((mj.nv, mj.nv))
    mujoco.mj_fullM(mj, data, M)
    M = to_theirs.T @ M @ to_theirs
    acceleration = np.linalg.solve(M, tau - to_theirs.T @ data.qfrc_bias)
    if free:  # our acceleration is in the body's own frame
        acceleration[3:6] -= np.cross(v[:3], v[3:6])
    moving = [b for b in range(1, mj.nbody) if mj.body_weldid[b] != 0]
    return float(sum(mj.body_mass[moving])), M, acceleration


def _pinocchio(path: Path, robot: Robot, q: Array, v: Array, tau: Array) -> Dynamics:
    import pinocchio as pin  # type: ignore[import-not-found]

    arguments = (str(path), pin.JointModelFreeFlyer()) if robot.floating else (str(path),)
    model = pin.buildModelFromUrdf(*arguments)
    data = model.createData()
    to_theirs = np.zeros((model.nv, model.nv))  # their velocity of ours: [linear, angular, joints], both in the body
    if robot.floating:
        to_theirs[:3, 3:6] = to_theirs[3:6, :3] = np.eye(3)
    theirs = pin.neutral(model)
    if robot.floating:
        theirs[:7] = [*q[:3], *q[4:7], q[3]]
    for i, name in enumerate(robot.independent):
        joint = model.joints[model.frames[model.getFrameId(name, pin.FrameType.BODY)].parentJoint]
        angle = q[robot.layout.joints_q + i]
        theirs[joint.idx_q : joint.idx_q + joint.nq] = angle if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        to_theirs[joint.idx_v, robot.layout.joints_v + i] = 1.0
    M = pin.crba(model, data, theirs)
    M = np.triu(M) + np.triu(M, 1).T
    acceleration = to_theirs.T @ pin.aba(model, data, theirs, to_theirs @ v, to_theirs @ tau)
    return float(pin.computeTotalMass(model)), to_theirs.T @ M @ to_theirs, acceleration
