"""Left-right symmetry: what a robot's reflection does to its observations and actions, worked out from its description.

Joints are paired by geometry: in the standing pose, the reflection of a joint's axis in the plane between left and
right is the axis of its partner. What that does to observations is found by looking at reflected states through the
task's own terms, so that terms of users count too; and that the dynamics commute with it is checked numerically.
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
"""Of points and linear velocities, in axes of the base: y points to the left."""

TWIST = np.concatenate([-REFLECTION, REFLECTION])
"""Of angular and linear velocities, accelerations and forces."""

NEAR, SIMILAR = 0.01, 0.05
"""How far the reflection of a joint may be from its partner [m]; how much reflected figures may differ, relatively."""

STATES = 64
"""How many states are tried."""

States = Mapping[str, NDArray]
"""Values of state buffers, one state per row."""


@dataclass(frozen=True)
class SignedPermutation:
    """A reflection of vectors.

    Attributes:
        index: Where each entry comes from, shape (n,).
        sign: What it is multiplied by, 1 or -1, shape (n,).
    """

    index: NDArray[np.int64]
    sign: NDArray[np.float32]

    def __call__(self, rows: NDArray) -> NDArray:
        """Return reflected vectors, shape (..., n)."""
        return rows[..., self.index] * self.sign.astype(rows.dtype)

    def repeated(self, count: int) -> SignedPermutation:
        """Return the reflection of so many vectors one after the other."""
        n = len(self.index)
        index = np.concatenate([self.index + i * n for i in range(count)])
        return SignedPermutation(index, np.tile(self.sign, count))


@dataclass(frozen=True)
class Symmetry:
    """The left-right reflection of a robot and its task.

    Attributes:
        observation: Of what the policy sees.
        critic: Of what the critic sees; None if it has no observation of its own, or one that cannot be reflected.
        action: Of actions.
        error: How much the acceleration of the reflected state differs from the reflected acceleration, relatively, of
            the base or of the joints: 0 for a robot whose figures are perfectly symmetric.
    """

    observation: SignedPermutation
    critic: SignedPermutation | None
    action: SignedPermutation
    error: float


def left_right(program: TaskProgram) -> Symmetry | None:
    """Return the left-right symmetry of a task on a robot; None if there is none.

    There is none if a joint has no partner, if the dynamics differ by more than 5 % from those of the reflection, if
    the task rewards one side more than the other, or if actions are those of motors.

    Examples:
        As `symmetry` of environments has it:

        >>> symmetry = gymnasium.make("ce_gym/MiniCheetahVelocity-v0").unwrapped.symmetry
        >>> observation = np.arange(48.0)
        >>> print(symmetry.observation(observation)[:3], symmetry.action.index)
        [ 0. -1.  2.] [ 3  4  5  0  1  2  9 10 11  6  7  8]
    """
    joints = paired_joints(program.model)
    if joints is None or program.actions.control not in ("position", "torque"):
        return None
    moved = {joint: i for i, joint in enumerate(program.actions.moved)}
    if any(int(joints.index[joint]) not in moved for joint in moved):
        return None
    partners = [moved[int(joints.index[joint])] for joint in moved]
    action = SignedPermutation(np.array(partners), joints.sign[list(moved)])
    rng = np.random.default_rng(0)
    error = dynamics_error(program.model, joints, rng)
    if error > SIMILAR:
        return None
    states = _states(program, rng)
    half = program.task.gait_period / program.control_dt / 2
    differences = {}
    for shift in (0.0, half):
        mirrored = _reflected(program, states, joints, action, shift)
        differences[shift] = _difference(*(_seen(program, program.reward_terms, s) for s in (states, mirrored)))
    shift = min(differences, key=differences.__getitem__)
    mirrored = _reflected(program, states, joints, action, shift)
    observation = _matched(*(_seen(program, program.observation_terms, s) for s in (states, mirrored)))
    if differences[shift] > SIMILAR or observation is None:
        return None
    critic = None
    if program.task.critic:
        terms = program.observation_terms | program.critic_terms
        critic = _matched(*(_seen(program, terms, s) for s in (states, mirrored)))
    return Symmetry(observation.repeated(program.task.history), critic, action, error)


def paired_joints(model: Model) -> SignedPermutation | None:
    """Return which independent joint is the reflection of which, and whether it turns the same way; None if one lacks.

    A rotation by an angle about an axis is, reflected, one by the same angle about minus the reflected axis; a shift is
    one along the reflected axis. There is none for robots with ball joints.
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
    turned = np.where((types == "revolute")[:, None], -axes * REFLECTION, axes * REFLECTION)
    distance = np.linalg.norm((origins * REFLECTION)[:, None] - origins[None], axis=2)
    along = turned @ axes.T
    fits = (distance < NEAR) & (np.abs(along) > 0.999) & (types[:, None] == types[None])
    partners = _partners(model, fits)
    if partners is None:
        return None
    partner = np.array(partners)
    sign = np.sign(along[np.arange(len(names)), partner])
    first = robot.layout.joints_q
    standing = model.standing_q[first : first + len(names)]
    if (partner[partner] != np.arange(len(names))).any() or np.abs(standing[partner] * sign - standing).max() > 1e-6:
        return None
    return SignedPermutation(partner, sign.astype(np.float32))


def _partners(model: Model, fits: NDArray[np.bool_]) -> list[int] | None:
    """Choose a partner for each joint among those that fit: one that is carried by the partner of what carries it."""
    robot, partner = model.robot, {-1: -1}  # -1 is the base
    number = {name: i for i, name in enumerate(robot.commanded)}

    def carrier(name: str) -> int:
        parent = robot.body(name).parent
        return -1 if parent is None else number[parent] if parent in number else carrier(parent)

    for body in robot.bodies:  # parents before children
        if (i := number.get(body.name)) is not None:
            wanted = partner[carrier(body.name)]
            found = [j for j, other in enumerate(robot.commanded) if fits[i, j] and carrier(other) == wanted]
            if not found:
                return None
            partner[i] = found[0]
    return [partner[i] for i in range(len(number))]


def dynamics_error(model: Model, joints: SignedPermutation, rng: np.random.Generator) -> float:
    """Return how much reflected accelerations differ from those of reflected states: RMS, the base's or the joints'."""
    q, v = _moved_states(model, rng, 8)
    n, tau = len(joints.index), np.zeros((8, model.nv))
    tau[:, 6 : 6 + n] = 10 * rng.standard_normal((8, n))
    expected = _mirror_v(model.forward_dynamics(q, v, tau), joints)
    found = model.forward_dynamics(_mirror_q(q, joints), _mirror_v(v, joints), _mirror_v(tau, joints))
    parts = (slice(0, 3), slice(3, 6), slice(6, 6 + n))
    return float(max(np.linalg.norm((found - expected)[:, p]) / np.linalg.norm(expected[:, p]) for p in parts))


def _moved_states(model: Model, rng: np.random.Generator, n: int) -> tuple[NDArray, NDArray]:
    """Random states near the standing pose, so that feet are on the ground and off it; nothing stretches."""
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
    """Random values of the state buffers that a reflection is known of."""
    sizes = program.state_sizes
    state = {name: rng.uniform(-1, 1, (STATES, size)) for name, size in sizes.items() if name in _KNOWN}
    state["q"], state["v"] = _moved_states(program.model, rng, STATES)
    state["clock"] = rng.uniform(0, 1000, (STATES, 1))  # not whole: whether a phase is 0 or 2 pi is left to rounding
    return state | {"previous_action": rng.uniform(-1, 1, state["action"].shape)}


_KNOWN = ("q", "v", "command", "action", "torque", "clock", "heading", "air_time", "load")


def _reflected(
    program: TaskProgram, state: States, joints: SignedPermutation, action: SignedPermutation, shift: float
) -> dict[str, NDArray]:
    """Return reflected states; the gait's clock is moved by a number of control steps."""
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
        at, n = np.array([points[name] for name in program.options.touches]), len(program.contacts)
        regions = n + _nearest(at[n:]) if len(at) > n else []
        result["load"] = state["load"][:, [*_nearest(at[:n]), *regions]]
    return result


def _contact_points(model: Model) -> dict[str, NDArray]:
    """Where the contact spheres are in the standing pose [m]."""
    positions, _ = model.contact_points(model.standing_q, np.zeros(model.nv))
    return dict(zip(model.contact_names, positions, strict=True))


def _nearest(points: NDArray) -> NDArray[np.int64]:
    """Which point is nearest to the reflection of each."""
    return np.linalg.norm((points * REFLECTION)[:, None] - points[None], axis=2).argmin(axis=1)


def _seen(program: TaskProgram, terms: Mapping, state: States) -> NDArray | None:
    """Values of terms, one state per row; None if they look at something whose reflection is not known."""
    function = program.stages.terms_function(terms)
    if not set(function.name_in()) <= state.keys():
        return None
    return np.array(function(*[ca.DM(state[name].T) for name in function.name_in()])).T.reshape(STATES, -1)


def _difference(values: NDArray | None, mirrored: NDArray | None) -> float:
    """How much values differ from those of reflected states, relatively, the worst; infinitely if that is not known."""
    if values is None or mirrored is None:
        return float("inf")
    size = np.abs(values).mean(axis=0)
    return float(np.max(np.abs(values - mirrored).mean(axis=0)[size > 0] / size[size > 0], initial=0.0))


def _matched(values: NDArray | None, mirrored: NDArray | None) -> SignedPermutation | None:
    """Return the signed permutation that turns values into those of the reflected states; None if there is none."""
    if values is None or mirrored is None:
        return None
    size = np.maximum(np.sqrt((mirrored**2).mean(axis=0)), 1e-9)
    gaps = np.stack(
        [np.sqrt(((mirrored[:, :, None] - sign * values[:, None, :]) ** 2).mean(axis=0)) for sign in (1, -1)]
    )
    gaps[0] -= 1e-9 * np.eye(len(size))  # what is constant stays where it is
    index, sign = gaps.min(axis=0).argmin(axis=1), np.ones(len(size), np.float32)
    rows = np.arange(len(size))
    sign[gaps[1, rows, index] < gaps[0, rows, index]] = -1
    if (gaps.min(axis=0)[rows, index] > SIMILAR * size).any() or (index[index] != rows).any():
        return None
    return SignedPermutation(index, sign)
