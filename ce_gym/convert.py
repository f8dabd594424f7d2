"""Positions, velocities and generalised forces in the order and conventions of Pinocchio, MuJoCo and robot files.

import pinocchio
from ce_gym.convert import Pinocchio

model = ce_gym.Model("go1")
pinocchio_model = pinocchio.buildModelFromUrdf("go1.urdf", pinocchio.JointModelFreeFlyer())
coordinates = Pinocchio(model, pinocchio_model)
q, v, tau = coordinates.from_model(model.standing_q, np.zeros(model.nv), np.zeros(model.nv))
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ce_gym.dynamics.model import Model
from ce_gym.model.coordinates import sizes
from ce_gym.model.errors import check_names

Array = NDArray[np.float64]

_SIZES = {"free": ((7, 6),), "ball": ((4, 3),)}
"""Positions and velocities of a joint in other programs, by type; a joint about an axis may have cosine and sine."""
_SCALAR = (1, 1), (2, 1)


@dataclass(frozen=True)
class _Joint:
    """A joint of another program.

    Attributes:
        name: The body of `Model` that it moves.
        q, v: Rows of its positions and velocities.
    """

    name: str
    q: range
    v: range


class _Coordinates:
    """Changes of coordinates between a `Model` and another program; `Pinocchio`, `MuJoCo` and `JointOrder` make them.

    Args:
        model: The model.
        joints: The joints of the other program that move bodies of the model.
        neutral: Positions of the other program, which joints that the model lacks keep, shape (its nq,).
        nv: Number of velocities of the other program.

    Raises:
        ValueError: If the other program lacks an independent joint of the model, or has another type of joint.
    """

    _QUATERNION: ClassVar[list[int]] = [0, 1, 2, 3]
    """Where the entries of a quaternion come from: (w, x, y, z) here."""
    _LINEAR_FIRST: ClassVar[bool] = True
    """Whether the linear part of the base's velocity comes first."""
    _LINEAR_IN_WORLD: ClassVar[bool] = False
    """Whether the linear part of the base's velocity is in the axes of the world."""

    def __init__(self, model: Model, joints: Sequence[_Joint], neutral: Array, nv: int) -> None:
        self.model, self.neutral, self.nv = model, neutral, nv
        self.joints = {joint.name: joint for joint in joints if joint.name in model.body_names and len(joint.v)}
        program = type(self).__name__
        for name in model.robot.rows:
            if name not in self.joints:
                raise ValueError(f"{program} has no joint that moves {name!r}; expected all joints of {model!r}")
        for name, joint in self.joints.items():
            kind = model.robot.body(name).joint.type
            if (len(joint.q), len(joint.v)) not in _SIZES.get(kind, _SCALAR):
                given = f"{len(joint.q)} positions and {len(joint.v)} velocities"
                raise ValueError(f"the joint of {name!r} has {given} in {program}; expected a joint of type {kind}")

    def from_model(self, q: ArrayLike, v: ArrayLike | None = None, tau: ArrayLike | None = None) -> tuple[Array, ...]:
        """Return positions, and velocities and forces if they are given, in the other program's coordinates.

        Dependent joints follow from the independent ones; forces are on the independent joints. Joints that the model
        lacks, such as joints of massless links, stay in their neutral position.

        Args:
            q: Positions of the model, shape (..., nq).
            v: Velocities, shape (..., nv).
            tau: Generalised forces, shape (..., nv).
        """
        q = self.model.unit(np.asarray(q, dtype=float))
        speeds = np.zeros(self.model.nv) if v is None else v
        q_span, v_span = self.model.spanning(q, speeds)
        result = [self._positions(q_span)]
        if v is not None:
            result.append(self._velocities(q, v_span))
        if tau is not None:
            tau = _of_size("tau", tau, self.model.nv)
            on_joints = np.zeros((*tau.shape[:-1], v_span.shape[-1]))
            for name, (_, rows) in self.model.robot.rows.items():
                on_joints[..., self.model.robot.spanning_rows[name][1]] = tau[..., rows]
            result.append(self._velocities(q, on_joints))
        return tuple(result)

    def to_model(self, q: ArrayLike, v: ArrayLike | None = None, tau: ArrayLike | None = None) -> tuple[Array, ...]:
        """Return positions, and velocities and forces if they are given, in the model's coordinates.

        Positions and velocities of dependent joints are ignored. Forces on dependent joints act on the independent
        ones through gears and loops.

        Args:
            q: Positions of the other program, shape (..., its nq).
            v: Velocities, shape (..., its nv).
            tau: Generalised forces, shape (..., its nv).
        """
        q = _of_size("q", q, len(self.neutral))
        positions = np.zeros((*q.shape[:-1], self.model.nq))
        for name, (rows, _) in self.model.robot.rows.items():
            positions[..., rows] = self._model_position(self.joints[name], q)
        positions = self.model.unit(positions)
        result = [positions]
        if v is not None:
            v_span = self._model_velocities(positions, _of_size("v", v, self.nv))
            rows = [row for name in self.model.robot.rows for row in self.model.robot.spanning_rows[name][1]]
            result.append(v_span[..., rows])
        if tau is not None:
            G = self.model.explicit_constraint(positions, np.zeros(self.model.nv))[0]
            on_joints = self._model_velocities(positions, _of_size("tau", tau, self.nv))
            result.append(np.einsum("...ij,...i->...j", G, on_joints))
        return tuple(result)

    def _joints(self) -> Iterator[tuple[str, _Joint, range, range]]:
        for name, joint in self.joints.items():
            yield self.model.robot.body(name).joint.type, joint, *self.model.robot.spanning_rows[name]

    def _positions(self, q_span: Array) -> Array:
        q = np.tile(self.neutral, (*q_span.shape[:-1], 1))
        for kind, joint, rows, _ in self._joints():
            x = q_span[..., rows]
            if kind in _SIZES:
                x = np.concatenate([x[..., :-4], x[..., -4:][..., self._QUATERNION]], axis=-1)
            elif len(joint.q) == 2:
                x = np.concatenate([np.cos(x), np.sin(x)], axis=-1)
            q[..., joint.q] = x
        return q

    def _model_position(self, joint: _Joint, q: Array) -> Array:
        x, kind = q[..., joint.q], self.model.robot.body(joint.name).joint.type
        if kind in _SIZES:
            return np.concatenate([x[..., :-4], x[..., -4:][..., np.argsort(self._QUATERNION)]], axis=-1)
        return np.arctan2(x[..., 1:], x[..., :1]) if len(joint.q) == 2 else x

    def _velocities(self, q: Array, v_span: Array) -> Array:
        """Return velocities, or forces, of the other program's joints, given the values of all joints of the model."""
        v = np.zeros((*np.broadcast_shapes(q.shape[:-1], v_span.shape[:-1]), self.nv))
        for kind, joint, _, rows in self._joints():
            x = v_span[..., rows]
            if kind == "free":
                angular, linear = x[..., :3], x[..., 3:]
                if self._LINEAR_IN_WORLD:
                    linear = _rotated(q[..., 3:7], linear)
                parts = [linear, angular] if self._LINEAR_FIRST else [angular, linear]
                x = np.concatenate(np.broadcast_arrays(*parts), axis=-1)
            v[..., joint.v] = x
        return v

    def _model_velocities(self, q: Array, v: Array) -> Array:
        """Return velocities, or forces, of all joints of the model; zero where the other program has no joint."""
        count = sum(len(rows) for _, rows in self.model.robot.spanning_rows.values())
        v_span = np.zeros((*np.broadcast_shapes(q.shape[:-1], v.shape[:-1]), count))
        for kind, joint, _, rows in self._joints():
            x = v[..., joint.v]
            if kind == "free":
                first, second = x[..., :3], x[..., 3:]
                angular, linear = (second, first) if self._LINEAR_FIRST else (first, second)
                if self._LINEAR_IN_WORLD:
                    linear = _rotated(q[..., 3:7] * [1.0, -1.0, -1.0, -1.0], linear)
                x = np.concatenate(np.broadcast_arrays(angular, linear), axis=-1)
            v_span[..., rows] = x
        return v_span


class Pinocchio(_Coordinates):
    """Coordinates of Pinocchio: quaternions (x, y, z, w), base velocity [linear; angular] in the base frame.

    A joint is found by the link that it moves, else by its name.

    Args:
        model: The model.
        pinocchio_model: A `pinocchio.Model` of the same robot.
    """

    _QUATERNION: ClassVar[list[int]] = [1, 2, 3, 0]

    def __init__(self, model: Model, pinocchio_model: Any) -> None:
        links: dict[int, str] = {}
        for frame in pinocchio_model.frames:
            if frame.type.name == "BODY":  # the first is the link that the joint moves
                links.setdefault(int(frame.parentJoint), frame.name)
        joints, neutral = [], np.zeros(pinocchio_model.nq)
        for i, joint in enumerate(pinocchio_model.joints):
            if i == 0:
                continue  # the universe
            q = range(joint.idx_q, joint.idx_q + joint.nq)
            name = _body_moved(model, links.get(i, ""), str(pinocchio_model.names[i]))
            joints.append(_Joint(name, q, range(joint.idx_v, joint.idx_v + joint.nv)))
            if joint.nq == 2:
                neutral[q[0]] = 1.0  # cosine
            elif joint.nq > 2:
                neutral[q[-1]] = 1.0
        super().__init__(model, joints, neutral, pinocchio_model.nv)


class MuJoCo(_Coordinates):
    """Coordinates of MuJoCo: base velocity [linear in the world; angular in the base frame].

    A joint is found by the body that it moves, else by its name. Of several joints of a body, the last moves the body.

    Args:
        model: The model.
        mujoco_model: A `mujoco.MjModel` of the same robot.
    """

    _LINEAR_IN_WORLD: ClassVar[bool] = True

    def __init__(self, model: Model, mujoco_model: Any) -> None:
        joints = []
        for j in range(mujoco_model.njnt):
            body = mujoco_model.body(mujoco_model.jnt_bodyid[j])
            is_last = j == body.jntadr[0] + body.jntnum[0] - 1
            name = _body_moved(model, body.name if is_last else "", mujoco_model.joint(j).name)
            nq, nv = {0: (7, 6), 1: (4, 3)}.get(int(mujoco_model.jnt_type[j]), (1, 1))
            q, v = int(mujoco_model.jnt_qposadr[j]), int(mujoco_model.jnt_dofadr[j])
            joints.append(_Joint(name, range(q, q + nq), range(v, v + nv)))
        super().__init__(model, joints, np.array(mujoco_model.qpos0), mujoco_model.nv)


class JointOrder(_Coordinates):
    """Coordinates of the model with joints in another order, for example the order of a robot file or driver.

    A floating base comes first, with the conventions of the model.

    Args:
        model: The model.
        joints: All joints in their order, by their names or by the links that they move; dependent joints may be among
            them.

    Raises:
        ValueError: If a joint does not exist or is listed twice, or an independent joint is missing.
    """

    _LINEAR_FIRST: ClassVar[bool] = False

    def __init__(self, model: Model, joints: Sequence[str]) -> None:
        links = {**{link: link for link in model.spanning_names}, **model.robot.links_by_joint}
        check_names("joints", joints, links, f"a joint of {model.robot.name}:", listed=", ".join(model.joint_names))
        base = [model.robot.bodies[0].name] if model.robot.floating else []
        placed, first_q, first_v = [], 0, 0
        for name in (*base, *(links[joint] for joint in joints)):
            nq, nv = sizes(model.robot.body(name).joint.type)
            placed.append(_Joint(name, range(first_q, first_q + nq), range(first_v, first_v + nv)))
            first_q, first_v = first_q + nq, first_v + nv
        super().__init__(model, placed, np.zeros(first_q), first_v)


def _rotated(quaternion: Array, x: Array) -> Array:
    """Return vectors (..., 3) turned by unit quaternions (w, x, y, z), shape (..., 4)."""
    w, u = quaternion[..., :1], quaternion[..., 1:]
    across = np.cross(u, x)
    return x + 2.0 * (w * across + np.cross(u, across))


def _body_moved(model: Model, link: str, joint: str) -> str:
    """Return the body of the model that a joint of another program moves; another name if the model has none."""
    return link if link in model.body_names else model.robot.links_by_joint.get(joint, joint)


def _of_size(name: str, x: ArrayLike, size: int) -> Array:
    """Return an array, which must have shape (..., size)."""
    array = np.asarray(x, dtype=float)
    if array.ndim == 0 or array.shape[-1] != size:
        raise ValueError(f"{name} has shape {array.shape}; expected (..., {size})")
    return array
