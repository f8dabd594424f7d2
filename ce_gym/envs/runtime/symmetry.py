"""Left-right symmetry: the reflection of a robot as signed permutations of its observations and actions.

Geometry gives the pairs of joints: in the standing pose, the axis of a joint is the reflected axis of its partner. The
terms of the task, evaluated at random states and at their reflections, give the permutation of observations. A
numerical check confirms that the dynamics commute with the reflection.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.envs.runtime.program import TaskProgram

REFLECTION = np.array([1.0, -1.0, 1.0])
"""Signs of points and linear velocities in axes of the base; y points to the left."""

TWIST = np.concatenate([-REFLECTION, REFLECTION])
"""Signs of spatial vectors: velocities and accelerations, angular and linear."""

MAX_DISTANCE, MAX_ERROR = 0.01, 0.05
"""Largest distance of a reflected joint from its partner [m]; largest relative difference of reflected values."""

STATES = 64
"""Number of random states for the comparison."""

States = Mapping[str, NDArray]
"""Values of state buffers, one state per row."""


@dataclass(frozen=True)
class SignedPermutation:
    """A permutation of the entries of a vector, with signs.

    Attributes:
        index: Index of the source of each entry, shape (n,).
        sign: Factor on each entry, 1 or -1, shape (n,).
    """

    index: NDArray[np.int64]
    sign: NDArray[np.float32]

    def __call__(self, rows: NDArray) -> NDArray:
        """Return reflected vectors, shape (..., n)."""
        return rows[..., self.index] * self.sign.astype(rows.dtype)

    def repeated(self, count: int) -> SignedPermutation:
        """Return the reflection of `count` vectors, stacked."""
        n = len(self.index)
        index = np.concatenate([self.index + i * n for i in range(count)])
        return SignedPermutation(index, np.tile(self.sign, count))


@dataclass(frozen=True)
class Symmetry:
    """The left-right reflection of a robot and its task.

    Attributes:
        observation: Reflection of the policy's observation.
        critic: Reflection of the critic's observation; None if the task has none, or if it has no reflection.
        action: Reflection of actions.
        error: Relative difference between accelerations of reflected states and reflected accelerations, of the base or
            the joints, the larger one; 0 for a robot with exactly symmetric parameters.
    """

    observation: SignedPermutation
    critic: SignedPermutation | None
    action: SignedPermutation
    error: float


def left_right(program: TaskProgram) -> Symmetry | None:
    """Return the left-right symmetry of a task on a robot.

    The result is None if a joint has no partner, if the reflected dynamics differ by more than 5 %, if the task rewards
    one side more than the other, or if actions are targets of motors.

    Examples:
        Environments have it as `symmetry`:

        >>> symmetry = gymnasium.make("ce_gym/MiniCheetahVelocity-v0").unwrapped.symmetry
        >>> observation = np.arange(48.0)
        >>> print(symmetry.observation(observation)[:3], symmetry.action.index)
        [ 0. -1.  2.] [ 3  4  5  0  1  2  9 10 11  6  7  8]
    """
    joints = paired_joints(program.model)
    if joints is None or program.actions.control not in ("position", "torque"):
        return None
    entries = {joint: i for i, joint in enumerate(program.actions.moved)}
    if any(int(joints.index[joint]) not in entries for joint in entries):
        return None
    partners = [entries[int(joints.index[joint])] for joint in entries]
    action = SignedPermutation(np.array(partners), joints.sign[list(entries)])
    rng = np.random.default_rng(0)
    error = dynamics_error(program.model, joints, rng)
    if error > MAX_ERROR:
        return None
    states = _states(program, rng)
    half = program.task.gait_period / program.control_dt / 2
    mirrored = {shift: _reflected(program, states, joints, action, shift) for shift in (0.0, half)}

    def values(terms: Mapping, shift: float) -> tuple[NDArray | None, NDArray | None]:
        return _values(program, terms, states), _values(program, terms, mirrored[shift])

    differences = {shift: _difference(*values(program.reward_terms, shift)) for shift in mirrored}
    shift = min(differences, key=differences.__getitem__)
    observation = _matched(*values(program.observation_terms, shift))
    if differences[shift] > MAX_ERROR or observation is None:
        return None
    terms = program.observation_terms | program.critic_terms
    critic = _matched(*values(terms, shift)) if program.task.critic else None
    return Symmetry(observation.repeated(program.task.history), critic, action, error)


def paired_joints(model: Model) -> SignedPermutation | None:
    """Return the partner of each independent joint and the sign of its motion; None if a joint has no partner.

    The reflection of a rotation about an axis is a rotation about minus the reflected axis. The reflection of a shift
    is a shift along the reflected axis. Robots with ball joints have no symmetry here.
    """
    robot, bodies = model.robot, model.mechanism.bodies
    if robot.balls:
        return None
    positions, rotations = model.body_poses(model.standing_q)
    row = {name: i for i, name in enumerate(model.body_names)}
    names = robot.commanded
    axes = np.array([rotations[row[name]] @ bodies[name].axis for name in names])
    origins = np.array([positions[row[name]] for name in names])
    types = np.array([bodies[name].joint.type for name in names])
    reflected = np.where((types == "revolute")[:, None], -axes * REFLECTION, axes * REFLECTION)
    distance = np.linalg.norm((origins * REFLECTION)[:, None] - origins[None], axis=2)
    cosine = reflected @ axes.T
    fits = (distance < MAX_DISTANCE) & (np.abs(cosine) > 0.999) & (types[:, None] == types[None])
    partners = _partners(model, fits)
    if partners is None:
        return None
    partner = np.array(partners)
    sign = np.sign(cosine[np.arange(len(names)), partner])
    first = robot.layout.joints_q
    standing = model.standing_q[first : first + len(names)]
    if (partner[partner] != np.arange(len(names))).any() or np.abs(standing[partner] * sign - standing).max() > 1e-6:
        return None
    return SignedPermutation(partner, sign.astype(np.float32))


def _partners(model: Model, fits: NDArray[np.bool_]) -> list[int] | None:
    """Return a partner of each joint among those that fit: the parent of the partner is the partner of the parent."""
    robot, partner = model.robot, {-1: -1}  # -1 is the base
    number = {name: i for i, name in enumerate(robot.commanded)}

    def parent_joint(name: str) -> int:
        parent = robot.body(name).parent
        return -1 if parent is None else number[parent] if parent in number else parent_joint(parent)

    for body in robot.bodies:  # parents before children
        if (i := number.get(body.name)) is not None:
            parent = partner[parent_joint(body.name)]
            candidates = [j for j, name in enumerate(robot.commanded) if fits[i, j] and parent_joint(name) == parent]
            if not candidates:
                return None
            partner[i] = candidates[0]
    return [partner[i] for i in range(len(number))]


def dynamics_error(model: Model, joints: SignedPermutation, rng: np.random.Generator) -> float:
    """Return the relative RMS difference of reflected accelerations and accelerations of reflected states.

    The result is the largest one of the angular and linear acceleration of the base and the joint accelerations.
    """
    q, v = _moved_states(model, rng, 8)
    n, tau = len(joints.index), np.zeros((8, model.nv))
    tau[:, 6 : 6 + n] = 10 * rng.standard_normal((8, n))
    expected = _mirror_v(model.forward_dynamics(q, v, tau), joints)
    actual = model.forward_dynamics(_mirror_q(q, joints), _mirror_v(v, joints), _mirror_v(tau, joints))
    parts = (slice(0, 3), slice(3, 6), slice(6, 6 + n))
    return float(max(np.linalg.norm((actual - expected)[:, p]) / np.linalg.norm(expected[:, p]) for p in parts))


def _moved_states(model: Model, rng: np.random.Generator, n: int) -> tuple[NDArray, NDArray]:
    """Return random states near the standing pose, with feet on and off the ground and transmissions unstretched."""
    q, joints = np.tile(model.standing_q, (n, 1)), len(model.joint_links)
    q[:, :3] += rng.uniform(-0.05, 0.05, (n, 3))
    q[:, 3:7] += rng.uniform(-0.1, 0.1, (n, 4))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    q[:, 7 : 7 + joints] += rng.uniform(-0.2, 0.2, (n, joints))
    v = np.zeros((n, model.nv))
    v[:, : 6 + joints] = rng.uniform(-1, 1, (n, 6 + joints))
    return q, v


def _mirror_q(q: NDArray, joints: SignedPermutation) -> NDArray:
    quaternion = np.concatenate([[1.0], -REFLECTION])  # its vector is an axis of rotation
    end = 7 + len(joints.index)
    return np.concatenate([q[:, :3] * REFLECTION, q[:, 3:7] * quaternion, joints(q[:, 7:end]), q[:, end:]], axis=1)


def _mirror_v(v: NDArray, joints: SignedPermutation) -> NDArray:
    end = 6 + len(joints.index)
    return np.concatenate([v[:, :6] * TWIST, joints(v[:, 6:end]), v[:, end:]], axis=1)


def _states(program: TaskProgram, rng: np.random.Generator) -> dict[str, NDArray]:
    """Return random values of the state buffers that `_reflected` can reflect."""
    sizes = program.state_sizes
    state = {name: rng.uniform(-1, 1, (STATES, size)) for name, size in sizes.items() if name in _REFLECTED}
    state["q"], state["v"] = _moved_states(program.model, rng, STATES)
    state["clock"] = rng.uniform(0, 1000, (STATES, 1))  # not whole, since rounding decides between phases 0 and 2 pi
    return state | {"previous_action": rng.uniform(-1, 1, state["action"].shape)}


_REFLECTED = ("q", "v", "command", "action", "torque", "clock", "heading", "air_time", "load")


def _reflected(
    program: TaskProgram, state: States, joints: SignedPermutation, action: SignedPermutation, shift: float
) -> dict[str, NDArray]:
    """Return reflected states with the gait clock advanced by `shift` control steps."""
    result = dict(state) | {"clock": state["clock"] + shift, "torque": joints(state["torque"])}
    result |= {"q": _mirror_q(state["q"], joints), "v": _mirror_v(state["v"], joints)}
    result |= {"command": state["command"] * [1, -1, -1]}
    result |= {name: action(state[name]) for name in ("action", "previous_action")}
    result |= {"heading": -state["heading"]} if "heading" in state else {}
    spheres = [contact for contact in program.model.robot.contacts if contact.group == "foot"]
    points = _contact_points(program.model)
    feet = list(dict.fromkeys(sphere.body for sphere in spheres))
    centres = np.array([np.mean([points[s.name] for s in spheres if s.body == foot], axis=0) for foot in feet])
    if "air_time" in state and len(feet):
        result["air_time"] = state["air_time"][:, _nearest(centres)]
    if "load" in state:
        places, n = np.array([points[name] for name in program.options.touches]), len(program.contacts)
        regions = n + _nearest(places[n:]) if len(places) > n else []
        result["load"] = state["load"][:, [*_nearest(places[:n]), *regions]]
    return result


def _contact_points(model: Model) -> dict[str, NDArray]:
    """Return the contact points in the standing pose by name [m]."""
    positions, _ = model.contact_points(model.standing_q, np.zeros(model.nv))
    return dict(zip(model.contact_names, positions, strict=True))


def _nearest(points: NDArray) -> NDArray[np.int64]:
    """Return for each point the index of the point nearest to its reflection."""
    return np.linalg.norm((points * REFLECTION)[:, None] - points[None], axis=2).argmin(axis=1)


def _values(program: TaskProgram, terms: Mapping, state: States) -> NDArray | None:
    """Return the values of terms, one state per row; None if they read a buffer that cannot be reflected."""
    function = program.stages.terms_function(terms)
    if not set(function.name_in()) <= state.keys():
        return None
    return np.array(function(*[ca.DM(state[name].T) for name in function.name_in()])).T.reshape(STATES, -1)


def _difference(values: NDArray | None, mirrored: NDArray | None) -> float:
    """Return the largest relative difference of values at states and at their reflections; infinity if unknown."""
    if values is None or mirrored is None:
        return float("inf")
    size = np.abs(values).mean(axis=0)
    return float(np.max(np.abs(values - mirrored).mean(axis=0)[size > 0] / size[size > 0], initial=0.0))


def _matched(values: NDArray | None, mirrored: NDArray | None) -> SignedPermutation | None:
    """Return the signed permutation from values at states to values at their reflections; None if none fits."""
    if values is None or mirrored is None:
        return None
    size = np.maximum(np.sqrt((mirrored**2).mean(axis=0)), 1e-9)
    squares = [(mirrored[:, :, None] - sign * values[:, None, :]) ** 2 for sign in (1, -1)]
    gaps = np.sqrt(np.stack([square.mean(axis=0) for square in squares]))
    gaps[0] -= 1e-9 * np.eye(len(size))  # constant entries keep their index
    index, sign = gaps.min(axis=0).argmin(axis=1), np.ones(len(size), np.float32)
    rows = np.arange(len(size))
    sign[gaps[1, rows, index] < gaps[0, rows, index]] = -1
    if (gaps.min(axis=0)[rows, index] > MAX_ERROR * size).any() or (index[index] != rows).any():
        return None
    return SignedPermutation(index, sign)
