"""States and small mechanisms shared by the tests of the dynamics."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import Body, Inertial, Joint, LinearConstraint, Placement, Robot, load_robot

sys.path.insert(0, str(Path(__file__).parent))  # makes facts.py importable by name


@pytest.fixture(scope="session", params=["mini_cheetah", "mit_humanoid_leg"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="session")
def random_state():
    """Return a function that draws valid random states (q, v) of a model, shapes (n, nq) and (n, nv)."""

    def draw(model: Model, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        q, v = rng.uniform(-1.5, 1.5, (count, model.nq)), rng.normal(0, 3, (count, model.nv))
        if model.robot.floating:
            q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
        return q, v

    return draw


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Q * np.sign(np.linalg.det(Q))


def random_link(rng: np.random.Generator, name: str, parent: str | None, joint: Joint) -> Body:
    A = rng.normal(size=(3, 3))
    inertia = 0.02 * (A @ A.T + np.eye(3))
    placement = Placement(tuple(rng.normal(0, 0.2, 3)), tuple(map(tuple, random_rotation(rng))))
    return Body(
        name,
        "link",
        parent,
        placement,
        joint,
        Inertial(1.0 + rng.random(), tuple(rng.normal(0, 0.1, 3)), tuple(map(tuple, inertia))),
    )


def rotor(rng: np.random.Generator, name: str, parent: str | None, lopsided: float, tilted: float) -> Body:
    """A rotor about a random axis; `lopsided` breaks its symmetry, `tilted` makes its axis no principal one."""
    placement = Placement(tuple(rng.normal(0, 0.1, 3)), tuple(map(tuple, random_rotation(rng))))
    inertia = ((2e-3 + lopsided, lopsided / 2, tilted), (lopsided / 2, 2e-3, 0.0), (tilted, 0.0, 3e-3))
    return Body(
        name, "rotor", parent, placement, Joint("revolute", (0.0, 0.0, 1.0)), Inertial(0.3, (0.0, 0.0, 0.02), inertia)
    )


@pytest.fixture(scope="session")
def awkward_robot():
    """Return a function that makes a floating robot with belts whose rotors sit on every possible carrier.

    Bodies of the one big cluster: thigh -> shank -> toe. Rotors: on the base (the output body), on the thigh and on the
    shank (inside the cluster), about axes parallel to nothing, with belts over several joints. Without `floating`, the
    world takes the place of the base.
    """

    def make(lopsided: float = 0.0, tilted: float = 0.0, floating: bool = True) -> Robot:
        rng = np.random.default_rng(7)
        axes = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), tuple(np.array([1.0, 2.0, 2.0]) / 3)]
        links = [random_link(rng, "base", None, Joint("free"))]
        for name, parent, axis in zip(("thigh", "shank", "toe"), ("base", "thigh", "shank"), axes, strict=True):
            links.append(random_link(rng, name, parent, Joint("revolute", axis)))
        rotors = [rotor(rng, f"{p}_rotor", p, lopsided, tilted) for p in ("base", "thigh", "shank")]
        ties = (
            LinearConstraint("a", (("base_rotor", 1.0), ("thigh", -6.0), ("shank", -3.0)), 0.1),
            LinearConstraint("b", (("thigh_rotor", 1.0), ("thigh", -2.0), ("shank", -9.0), ("toe", 4.0))),
            LinearConstraint("c", (("shank_rotor", 1.0), ("thigh", 3.0), ("toe", 7.0))),
        )
        bodies = links + rotors
        if not floating:
            bodies = [replace(b, parent=None if b.parent == "base" else b.parent) for b in bodies if b.name != "base"]
        return Robot("awkward", tuple(bodies), ties, ("thigh", "shank", "toe"))

    return make
