# pyright: reportAttributeAccessIssue=false
"""MuJoCo in the accuracy benchmark: the same scene by MJCF export and `mujoco.rollout`."""

from __future__ import annotations

import copy
import warnings

import mujoco
import numpy as np
from mujoco import rollout

from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene
from ce_gym.bench.accuracy.statements import ratios, stated
from ce_gym.dynamics.model import Model
from ce_gym.export import mujoco_model
from ce_gym.export.mujoco_batch import STATE
from ce_gym.export.mujoco_coordinates import joint_rows
from ce_gym.export.mujoco_model import STIFF, Settings
from ce_gym.model.mechanism import ELASTIC

mujoco.set_mju_user_warning(lambda _: None)  # no log file; `Peer.diverged` has the information


def compiled(scene: Scene, level: str, stiff: bool = False) -> mujoco.MjModel:
    """Return the MuJoCo model of a scene at a level; torques act on the joints directly, without actuators."""
    robot, level, also = stated(scene, level)
    model = mujoco_model.compile_model(robot, level, Settings(1e-3, solimp=STIFF if stiff else None), also)
    if scene.control == "torque":
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return model


def initial_state(scene: Scene, model: mujoco.MjModel) -> mujoco.MjData:
    """Return MuJoCo's data at the start of the scene, with all joints and rotors."""
    ours, data = Model(scene.robot), mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    q, v = ours.spanning(scene.q, scene.v)
    if scene.robot.floating:
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, scene.q[3:7])
        data.qpos[:7] = q[:7]
        data.qvel[:3], data.qvel[3:6] = rotation.reshape(3, 3) @ v[3:6], v[:3]
        q, v = q[7:], v[6:]
    known = dict(zip(ours.spanning_names, zip(q, v, strict=True), strict=True))
    for joint in range(1 if scene.robot.floating else 0, model.njnt):
        address, dof = model.jnt_qposadr[joint], model.jnt_dofadr[joint]
        data.qpos[address], data.qvel[dof] = known[model.body(model.jnt_bodyid[joint]).name]
    return data


def forces(scene: Scene, model: mujoco.MjModel, hold: int, level: str) -> Array:
    """Return applied generalised forces during a hold in MuJoCo's coordinates, shape (nv,)."""
    force = np.zeros(model.nv)
    if scene.control == "torque":
        names, torques = scene.robot.independent, scene.drive[hold]
        if level == ELASTIC:  # motors turn rotors
            names, of = tuple(elastic.rotor for elastic in scene.robot.elastic), ratios(scene.robot)
            W = np.array([[of[rotor].get(joint, 0.0) for joint in scene.robot.independent] for rotor in names])
            torques = np.linalg.solve(W.T, torques)
        rows = joint_rows(model)
        for name, torque in zip(names, torques, strict=True):
            force[rows[name][1]] = torque
    if scene.push is not None:  # at the origin of the base, which is its centre of mass
        force[:3] += model.body_mass[1] * scene.push[hold]
    return force


class Family:
    """A scene in MuJoCo at one transmission level with one kind of equality constraints.

    Args:
        scene: The scene.
        level: Transmission level.
        stiff: Whether equality constraints are as stiff as the step allows, or MuJoCo's default.
    """

    def __init__(self, scene: Scene, level: str, stiff: bool) -> None:
        self.scene, self.level, self.stiff = scene, level, stiff
        self.name = f"{level}, stiff equalities" if stiff else level
        self.model = compiled(scene, level, stiff)
        self.start = np.empty(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, initial_state(scene, self.model), self.start, STATE)
        if scene.control == "torque":
            self.spec = mujoco.mjtState.mjSTATE_QFRC_APPLIED
            self.control = np.array([forces(scene, self.model, i, level) for i in range(scene.holds)])
        else:
            driven = [scene.robot.commanded.index(name) for name in scene.robot.driven]
            self.spec, self.control = mujoco.mjtState.mjSTATE_CTRL, scene.drive[:, driven]

    @property
    def tied(self) -> bool:
        """Return whether the model has equality constraints."""
        return self.model.neq > 0


def families(scene: Scene) -> list[Family]:
    """Return all families of a scene: levels, and stiff equality constraints for levels with constraints."""
    soft = [Family(scene, level, stiff=False) for level in scene.levels]
    return [*soft, *(Family(scene, family.level, stiff=True) for family in soft if family.tied)]


class Peer:
    """One robot in MuJoCo in a scene.

    Args:
        family: Scene, level and equality constraints.
        integrator: "Euler", "implicitfast", "discrete" or "RK4".
        per_hold: Steps per hold.
    """

    def __init__(self, family: Family, integrator: str, per_hold: int) -> None:
        self.family, self.per_hold = family, per_hold
        self.model = copy.copy(family.model)
        self.model.opt.timestep = HOLD / per_hold
        self.model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        if family.stiff:
            self.model.eq_solref[:] = (2.0 * HOLD / per_hold, 1.0)
        self.data = mujoco.MjData(self.model)
        self.control = np.repeat(family.control, per_hold, axis=0)[None]
        self.states = np.empty((1, self.control.shape[1], len(family.start)))
        self.pool = rollout.Rollout(nthread=0)

    def run(self) -> Array:
        """Simulate the scene; return positions of ce_gym at the end of every hold, shape (n_holds, nq)."""
        start, spec = self.family.start, int(self.family.spec)
        self.data.warning.number[:] = 0
        mujoco.mj_setState(self.model, self.data, start, STATE)
        self.data.qacc_warmstart[:] = 0.0
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.pool.rollout(self.model, self.data, start[None], self.control, control_spec=spec, state=self.states)
        ends = self.states[0, self.per_hold - 1 :: self.per_hold, 1 : 1 + self.model.nq]
        return positions(self.family.scene, self.model, ends) * (np.nan if self.diverged else 1.0)

    @property
    def diverged(self) -> bool:
        """Return whether MuJoCo warned of a bad state in the last run, after which MuJoCo resets the robot."""
        bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
        return any(self.data.warning[int(kind)].number > 0 for kind in bad)


def positions(scene: Scene, model: mujoco.MjModel, qpos: Array) -> Array:
    """Convert positions from MuJoCo to coordinates of ce_gym, shape (..., nq)."""
    rows = joint_rows(model)
    joints = [rows[name][0] for name in scene.robot.independent]
    return qpos[..., [*range(7 if scene.robot.floating else 0), *joints]]
