"""Linearizations of small random robots against the reverse mode and central differences."""

import time

import numpy as np
import pytest
from small_mechanisms import inertial

from ce_gym import Model, Simulator, StepDerivatives
from ce_gym.model import Body, ContactSphere, Joint, LinearConstraint, Motor, Placement, Pose, Robot
from ce_gym.model.description import Gains
from ce_gym.model.mechanism import LEVELS

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8))
STEP = 1e-6


def small_robot(rng: np.random.Generator) -> Robot:
    """Return a tree of up to three joints, on a floating or fixed base, some of them with a geared motor."""
    floating = rng.random() < 0.6
    bodies = [Body("base", "link", None, Placement(), Joint("free"), inertial(2.0, (0.02, 0.03, 0.04)))] * floating
    independent, ties, motors = [], [], []
    for i in range(rng.integers(0 if floating else 1, 4)):
        parent = bodies[rng.integers(len(bodies))].name if bodies else None
        at = (0.0, 0.0, -0.1) if rng.random() < 0.5 else (0.1, 0.05, -0.02)
        kind, axis = rng.choice(["revolute", "prismatic", "ball"], p=[0.6, 0.2, 0.2]), AXES[rng.integers(4)]
        joint = Joint(str(kind), axis, **({} if kind == "ball" else {"torque": 5.0}))  # type: ignore[arg-type]
        com = (0.0, 0.0, -0.1) if rng.random() < 0.5 else (0.03, 0.02, -0.1)
        bodies.append(Body(f"link{i}", "link", parent, Placement(at), joint, inertial(0.5, (0.01, 0.012, 0.005), com)))
        independent += [f"link{i}"] if kind != "ball" else []
    names = [body.name for body in bodies]
    for name in independent:
        carrier = bodies[names.index(name)].parent
        if rng.random() < 0.5:
            moved = inertial(0.1, (1e-5, 1e-5, 2e-5))
            bodies.append(Body(f"{name}_rotor", "rotor", carrier, Placement(), Joint("revolute", AXES[2]), moved))
            ties.append(LinearConstraint(f"{name}_gear", ((f"{name}_rotor", 1.0), (name, -6.0))))
            motors.append(Motor(f"{name}_rotor", torque=1.0, velocity=100.0))
    gains = [tuple((name, value) for name in independent) for value in (20.0, 0.5)]
    spheres = (
        ContactSphere("foot", names[-1], (0.02, 0.0, -0.15), 0.02),
        ContactSphere("hip", names[0], (0.0,) * 3, 0.05),
    )
    return Robot(
        "small",
        tuple(bodies),
        tuple(ties),
        tuple(independent),
        contacts=spheres if floating else (),
        motors=tuple(motors),
        pose=Pose(height=0.5),
        gains=Gains(*gains),
    )


def check_linearization(seed: int) -> None:
    """Compare the linearizations of a small robot.

    Raises:
        AssertionError: They differ.
    """
    rng = np.random.default_rng(seed)
    model = Model(small_robot(rng), str(rng.choice(LEVELS)))
    contacts = "all" if rng.random() < 0.6 else ()
    control, motors = str(rng.choice(["position", "torque"])), str(rng.choice(["ideal", "limited"]))
    sim = Simulator(model, 3, contacts=contacts, control=control, motors=motors)
    q = np.tile(model.standing_q, (3, 1)) + 0.05 * rng.normal(size=(3, model.nq))
    if model.robot.floating:
        q[:, 2] = rng.uniform(0.2, 0.5, 3)
    for row, _ in model.robot.layout.turns:
        q[:, row : row + 4] /= np.linalg.norm(q[:, row : row + 4], axis=1, keepdims=True)
    sim.set_state(q, rng.normal(0, 0.3, (3, model.nv)))
    targets = rng.normal(0, 0.1, (3, len(sim.target_names)))
    sim.step(targets, int(rng.integers(3)))
    start, derivatives = sim.snapshot(), StepDerivatives(sim)
    A, B = derivatives.linearize(targets, whole_state=True)
    by_rows = derivatives.linearize(targets, whole_state=True, by_rows=True)
    for ours, theirs in zip((A, B), by_rows, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9 * max(1.0, np.abs(theirs).max(initial=0)))
    q, v = start["q"].astype(float), start["v"].astype(float)

    def after(direction: np.ndarray) -> np.ndarray:
        sim.restore(start)
        derivatives.restore({"q": model.integrate(q, np.tile(direction[: model.nv], (3, 1)))})
        derivatives.restore({"v": v + direction[model.nv : 2 * model.nv]})
        sim.step(targets + direction[2 * model.nv :])
        return np.hstack([sim.q, sim.v])

    n, m = 2 * model.nv, targets.shape[1]
    for direction in rng.normal(size=(2, n + m)):
        forwards, backwards = after(STEP * direction), after(-STEP * direction)
        dq = model.difference(backwards[:, : model.nq], forwards[:, : model.nq])
        difference = np.hstack([dq, forwards[:, model.nq :] - backwards[:, model.nq :]]) / (2 * STEP)
        expected = A[:, :n, :n] @ direction[:n] + B[:, :n] @ direction[n:]
        np.testing.assert_allclose(difference, expected, rtol=0, atol=1e-4 * max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize("seed", range(4))
def test_linearizations_of_small_robots(seed: int):
    check_linearization(seed)


@pytest.mark.stress
def test_linearizations_for_longer(minutes):
    end, seed = time.perf_counter() + 60 * minutes, 1000
    while time.perf_counter() < end:
        check_linearization(seed)
        seed += 1
