"""A three-body robot with a stand-in for its model: kinematics in a dozen lines, independent of ce_gym.dynamics."""

from __future__ import annotations

import numpy as np

from ce_gym.model.description import Body, ContactSphere, Inertial, Joint, Robot, Shape
from ce_gym.model.frames import Placement
from ce_gym.viewer import Rollout

QUARTER = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
INERTIAL = Inertial(1.0, (0.0, 0.0, 0.0), ((0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.02)))


def make_robot(*, shapes: bool = True, rotor_shape: bool = True) -> Robot:
    """A floating box with a turned leg and a rotor about y."""
    box = (Shape("box", (0.4, 0.2, 0.1), color=(0.2, 0.3, 0.4, 1.0)),)
    leg = (Shape("capsule", (0.03, 0.2), Placement((0.0, 0.0, -0.1))), Shape("sphere", (0.04,)))
    disc = (Shape("cylinder", (0.05, 0.02)),)
    bodies = (
        Body("base", "link", None, Placement(), Joint("free"), INERTIAL, box if shapes else ()),
        Body(
            "leg/1",
            "link",
            "base",
            Placement((0.2, 0.1, 0.0), QUARTER),
            Joint("revolute", (1.0, 0.0, 0.0)),
            INERTIAL,
            leg if shapes else (),
        ),
        Body(
            "rotor",
            "rotor",
            "base",
            Placement((0.1, 0.0, 0.0)),
            Joint("revolute", (0.0, 1.0, 0.0)),
            INERTIAL,
            disc if shapes and rotor_shape else (),
        ),
    )
    return Robot("hopper", bodies, contacts=(ContactSphere("foot", "leg/1", (0.0, 0.0, -0.25), 0.02),))


class StandIn:
    """The part of `Model` that the viewer uses; q = base position, yaw, leg angle, rotor angle."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.body_names = tuple(body.name for body in robot.bodies)
        self.contact_names = tuple(contact.name for contact in robot.contacts)

    def body_poses(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if q.shape[-1] != 6:
            raise ValueError(f"q has {q.shape[-1]} columns; expected 6")
        base = turn((0, 0, 1), q[:, 3])
        positions, rotations = [q[:, :3]], [base]
        for body, angle in zip(self.robot.bodies[1:], q[:, 4:].T, strict=True):
            positions.append(q[:, :3] + base @ np.array(body.placement.position))
            rotations.append(base @ np.array(body.placement.rotation) @ turn(body.joint.axis, angle))
        return np.stack(positions, 1), np.stack(rotations, 1)


def turn(axis: tuple[float, ...], angle: np.ndarray) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], float)
    angle = np.asarray(angle)[..., None, None]
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def make_rollout(frames: int = 50, step: float = 0.02, **changes: object) -> Rollout:
    t = step * np.arange(frames)
    q = np.column_stack([0.5 * t, 0.1 * t, 0.3 + 0 * t, 2.0 * t, np.sin(5 * t), 40 * t])
    force = np.zeros((frames, 1, 3))
    force[:, 0, 2] = 30 * np.abs(np.sin(8 * t))
    values = {
        "robot": "hopper",
        "transmission": "exact",
        "dt": step,
        "times": t,
        "q": q,
        "v": np.gradient(q, axis=0) if frames > 1 else 0 * q,
        "contact_forces": force,
        "commands": np.tile([0.5, 0.1, 0.0], (frames, 1)),
        "label": "test",
        "info": {"seed": "1"},
    }
    return Rollout(**{**values, **changes})
