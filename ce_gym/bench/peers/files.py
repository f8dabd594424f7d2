# pyright: reportAttributeAccessIssue=false
"""Robot files of others, in a folder: which load, what is left out, whether MuJoCo or Pinocchio finds the same robot.

For a checkout of Menagerie, or the cache of robot_descriptions. MJCF files are compared with MuJoCo, URDF files with
Pinocchio: total mass, mass matrix and accelerations in a random state, at `armature`. Files with tied joints or loops
load but are not compared, since the peers solve those softly. (Compiled modules carry no types, hence the line above.)
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Cell, Report, Requirement, Table
from ce_gym.dynamics.model import Model
from ce_gym.model import InertiaWarning, LossyImportWarning, Robot, RobotError, load_robot
from ce_gym.model.formats.mjcf.balls import balls_in_loops
from ce_gym.model.formats.mjcf.bodies import read_bodies
from ce_gym.model.formats.mjcf.equalities import locked_joints
from ce_gym.model.formats.mjcf.source import read_mjcf
from ce_gym.viewer.console import shown

Array = NDArray[np.float64]
Dynamics = tuple[float, Array, Array]  # total mass [kg], mass matrix, acceleration, both in our coordinates

BAR = 1e-9
COLUMNS = ("file", "outcome", "joints", "mass [kg]", "mass", "mass matrix", "acceleration", "left out")
LONGEST = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the benchmark."""
    parser.add_argument("folder", type=Path, help="a folder with MJCF and URDF files, searched with all below it")


def run(arguments: argparse.Namespace) -> Report:
    """Try every file."""
    report = Report("files")
    with warnings.catch_warnings():
        for category in (LossyImportWarning, InertiaWarning):
            warnings.simplefilter("ignore", category)
        rows = tuple(row(path, arguments.folder) for path in shown(list(files(arguments.folder)), "files"))
    report.tables.append(Table("Robot files, differences from the peer relative to its largest figure", COLUMNS, rows))
    loaded = sum(cells[1] in ("same", "loads") for cells in rows)
    claim = f"figures beside the peer's <= {BAR:g} where they are compared"
    errors = [float(x) for cells in rows for x in cells[4:7] if x is not None]
    report.requirements.append(Requirement(claim, f"{max(errors, default=0.0):.1e}", max(errors, default=0.0) <= BAR))
    report.remarks.append(f"{loaded} of {len(rows)} files load")
    return report


def files(folder: Path) -> Iterator[Path]:
    """Iterate over files that describe a robot: URDF, and MJCF with a body that moves."""
    for path in sorted(folder.rglob("*.urdf")) + sorted(folder.rglob("*.xml")):
        text = path.read_text(encoding="utf-8", errors="replace")
        if path.suffix == ".urdf" or ("<mujoco" in text and "joint" in text and "<body" in text):
            yield path


def row(path: Path, folder: Path) -> tuple[Cell, ...]:
    """Return the row of one file."""
    name = str(path.relative_to(folder))
    try:
        robot = load_robot(path)
        model = Model(robot, "armature")
    except RobotError as error:
        reason = str(error).removeprefix(f"{path}: ")
        return (name, reason if len(reason) <= LONGEST else f"{reason[:LONGEST]}...", *[None] * 6)
    facts = (len(robot.independent), robot.total_mass)
    if any(not _is_gear(robot, tie.name) for tie in robot.constraints):
        return (name, "loads", *facts, None, None, None, len(robot.notes))
    q, v, tau = _state(model)
    try:
        theirs = (_pinocchio if path.suffix == ".urdf" else _mujoco)(path, robot, q, v, tau)
    except Exception as error:  # a peer that cannot read the file, or is not installed
        return (name, f"loads; no peer ({type(error).__name__})", *facts, None, None, None, len(robot.notes))
    ours = (robot.total_mass, model.mass_matrix(q), model.forward_dynamics(q, v, tau))
    errors = [float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(ours, theirs, strict=True)]
    return (name, "same" if max(errors) <= BAR else "DIFFERS", *facts, *errors, len(robot.notes))


def _is_gear(robot: Robot, tie: str) -> bool:
    """Whether a tie is that of a rotor which the reader has made of armature."""
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
    if free:  # ours is that of the body's own frame
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
