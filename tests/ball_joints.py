"""A robot with ball joints between joints of all other types, and how far apart two configurations of it are."""

from __future__ import annotations

import numpy as np

from ce_gym.model import Body, Inertial, Joint, Placement, Robot


def turned(rng: np.random.Generator) -> np.ndarray:
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return q * np.linalg.det(q)


def tuples(x: np.ndarray):
    return tuple(map(tuples, x)) if x.ndim else float(x)


def part(rng: np.random.Generator, name: str, parent: str | None, joint: Joint) -> Body:
    """A body with random figures in a random place."""
    a = rng.uniform(-1, 1, (3, 3))
    inertia = 0.01 * (np.trace(a @ a.T) * np.eye(3) - a @ a.T) + 0.005 * np.eye(3)
    mass, com = float(rng.uniform(0.5, 2)), tuples(rng.uniform(-0.2, 0.2, 3))
    place = Placement(tuples(rng.uniform(-0.3, 0.3, 3)), tuples(turned(rng))) if joint.type != "free" else Placement()
    return Body(name, "link", parent, place, joint, Inertial(mass, com, tuples((inertia + inertia.T) / 2)))


def with_balls(floating: bool, **ball) -> Robot:
    """A chain of ball, hinge, ball and slide, and a ball on its first body; `ball` are figures of their joints."""
    rng = np.random.default_rng(0)
    bodies = [part(rng, "base", None, Joint("free"))] if floating else []
    joints = {
        "a": ("base" if floating else None, Joint("ball", **ball)),
        "b": ("a", Joint("revolute", (0.0, 0.6, 0.8))),
        "c": ("b", Joint("ball", **ball)),
        "d": ("c", Joint("prismatic", (0.8, 0.0, 0.6))),
        "e": ("a", Joint("ball", **ball)),
    }
    bodies += [part(rng, name, parent, joint) for name, (parent, joint) in joints.items()]
    return Robot("with_balls", tuple(bodies), independent=("b", "d"))


def random_state(robot: Robot, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng, layout = np.random.default_rng(seed), robot.layout
    q, v = rng.uniform(-1, 1, layout.nq), rng.uniform(-1, 1, layout.nv)
    for i, _ in layout.turns:
        q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    return q, v


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's, quaternions (w, x, y, z)."""
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Body to parent, by turning the axes."""
    back = quaternion * [1, -1, -1, -1]
    return np.array([product(product(quaternion, np.array([0, *axis])), back)[1:] for axis in np.eye(3)]).T


def moved(robot: Robot, q: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """A configuration moved along a tangent, shape (nv,)."""
    layout, after = robot.layout, q.copy()
    if layout.floating:
        after[:3] += rotation(q[3:7]) @ tangent[3:6]
    for i, j in layout.turns:
        angle = max(float(np.linalg.norm(tangent[j : j + 3])), 1e-30)
        half = np.array([np.cos(angle / 2), *(np.sin(angle / 2) / angle * tangent[j : j + 3])])
        after[i : i + 4] = product(q[i : i + 4], half)
    after[layout.joints_q :] += tangent[layout.joints_v :]
    return after


def difference(robot: Robot, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The small tangent that moves `b` to `a`, shape (nv,)."""
    layout, tangent = robot.layout, np.zeros(robot.layout.nv)
    if layout.floating:
        tangent[3:6] = rotation(b[3:7]).T @ (a[:3] - b[:3])
    for i, j in layout.turns:
        tangent[j : j + 3] = 2 * product(b[i : i + 4] * [1, -1, -1, -1], a[i : i + 4])[1:]
    tangent[layout.joints_v :] = a[layout.joints_q :] - b[layout.joints_q :]
    return tangent
