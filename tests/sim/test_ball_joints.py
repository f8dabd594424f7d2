"""Ball joints in time: a top in closed form, a pendulum's invariants, what never grows, stops, and slopes of a step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_joints import difference, moved, random_state, rotation, with_balls

import ce_gym
from ce_gym.model import Body, ContactSphere, Inertial, Joint, Placement, Robot

NOTHING = np.zeros(0)


def body(moments: tuple[float, float, float], com=(0.0, 0.0, 0.0), **joint) -> Robot:
    """One body on a ball joint on the world."""
    inertial = Inertial(1.0, com, tuple(map(tuple, np.diag(moments).tolist())))
    return Robot("body", (Body("body", "link", None, Placement(), Joint("ball", **joint), inertial),))


def simulator(robot: Robot, method: str, dt: float, **options) -> ce_gym.Simulator:
    asked = {"control": "torque", "contacts": (), "outputs": (), **options}
    return ce_gym.Simulator(ce_gym.Model(robot), dt=dt, method=method, **asked)


def turn(vector: np.ndarray) -> np.ndarray:
    """The rotation by a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def test_a_symmetric_top_is_its_closed_form():
    """It precesses about its angular momentum: R(t) = exp(L t / A) exp(-(C - A) / A w3 t e3), Landau, Lifshitz 33."""
    A, C, w, T = 0.02, 0.05, np.array([3.0, 0.0, 10.0]), 0.5
    nutation = (C - A) / A * w[2] * T
    expected = turn(np.array([A, A, C]) * w / A * T) @ turn(np.array([0.0, 0.0, -nutation]))
    spin = np.array([w[0] * np.cos(nutation), w[0] * np.sin(nutation), w[2]])
    errors = {}
    for method, dt in (("rk4", 0.01), ("rk4", 0.005), ("extrapolated", 0.004), ("extrapolated", 0.002)):
        sim = simulator(body((A, A, C)), method, dt)
        sim.set_state([1, 0, 0, 0], w)
        sim.step(NOTHING, round(T / dt))
        orientation = np.abs(rotation(sim.q[0]) - expected).max()
        errors.setdefault(method, []).append(max(orientation, np.abs(sim.v[0] - spin).max()))
    orders = {method: np.log2(coarse / fine) for method, (coarse, fine) in errors.items()}
    assert errors["rk4"][1] < 1e-4
    assert orders["rk4"] == pytest.approx(4, abs=0.3)
    assert orders["extrapolated"] == pytest.approx(2, abs=0.3)


def test_a_pendulum_keeps_energy_and_angular_momentum():
    robot, r = body((0.01, 0.02, 0.03), com=(0.0, 0.0, -0.5)), np.array([0.0, 0.0, -0.5])
    about_joint = np.diag([0.01, 0.02, 0.03]) + r @ r * np.eye(3) - np.outer(r, r)
    sim = simulator(robot, "rk8", 0.01)

    def invariants() -> np.ndarray:
        q, v = sim.q[0], sim.v[0]
        energy = v @ about_joint @ v / 2 + 9.81 * (rotation(q) @ r)[2]
        return np.array([energy, (rotation(q) @ about_joint @ v)[2]])

    sim.set_state([np.cos(0.5), np.sin(0.5), 0, 0], [0.3, 2.0, 1.0])
    before = invariants()
    np.testing.assert_allclose([sum(sim.model.energy(sim.q[0], sim.v[0]))], before[:1], rtol=1e-12)
    sim.step(NOTHING, 300)
    np.testing.assert_allclose(invariants(), before, rtol=1e-8)


def test_a_tumbling_body_gains_no_energy():
    """About its middle axis, at a step in which it turns by 0.1 rad; explicit gyroscopic terms would add energy."""
    moments = np.array([0.01, 0.02, 0.029])
    sim, energy = simulator(body(tuple(moments)), "euler", 0.005), []
    sim.set_state([1, 0, 0, 0], [0.1, 20.0, 0.1])
    for _ in range(200):
        energy.append(moments @ sim.v[0] ** 2 / 2)
        sim.step(NOTHING, 1)
    assert np.diff(energy).max() <= 1e-12
    assert energy[-1] > 0.5 * energy[0]


def test_damping_and_stop():
    """A damped pendulum thrown against its stop stays near it and loses energy; damping alone is exponential."""
    furthest, damping = 0.4, 0.05
    robot = body((0.01, 0.01, 0.01), com=(0.0, 0.0, -0.5), damping=damping, position=(-np.inf, furthest))
    sim = simulator(robot, "euler", 0.001, outputs=("energy",))
    sim.set_state([1, 0, 0, 0], [3.0, 1.0, 0.0])
    angles, energy = [], []
    for _ in range(60):
        sim.step(NOTHING, 10)
        angles.append(2 * np.arccos(min(abs(sim.q[0, 0]), 1.0)))
        energy.append(sim.energy[0].sum())
    assert 0.9 * furthest < max(angles) < 1.2 * furthest
    assert np.diff(energy).max() < 1e-9
    free = simulator(replace(body((0.01, 0.01, 0.01), damping=damping), gravity=(0.0, 0.0, 0.0)), "extrapolated", 0.001)
    free.set_state([1, 0, 0, 0], [1.0, 2.0, 3.0])
    free.step(NOTHING, 200)
    np.testing.assert_allclose(free.v[0], np.array([1.0, 2.0, 3.0]) * np.exp(-damping / 0.01 * 0.2), rtol=1e-3)


@pytest.mark.slow
def test_slopes_of_a_step():
    """On the ground, beyond a stop, with damping: against central differences, all at once and in reverse."""
    robot = with_balls(True, damping=0.2, position=(-np.inf, 0.3))
    contacts = (ContactSphere("foot", "e", (0.1, 0.0, -0.1), 0.05), ContactSphere("belly", "base", (0.0,) * 3, 0.2))
    bodies = tuple(body for body in robot.bodies if body.name not in ("c", "d"))
    robot, h = replace(robot, bodies=bodies, independent=("b",), contacts=contacts), 1e-6
    sim = simulator(robot, "euler", 0.001, contacts=("foot", "belly"), outputs=("contact_forces",))
    nv, target, derivatives = sim.model.nv, np.array([0.3]), ce_gym.StepDerivatives(sim)
    q, v = moved(robot, sim.model.standing_q, random_state(robot, 2)[1] * 0.5), random_state(robot, 3)[1]
    q[2] = 0.1

    sim.set_state(q, v)
    start = derivatives.state()  # the load of contacts, which friction remembers, stays

    def after(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        derivatives.restore({**start, "q": moved(robot, q, change[:nv])[None], "v": (v + change[nv:])[None]})
        sim.step(target)
        return sim.q[0], sim.v[0]

    middle = after(np.zeros(2 * nv))[0]
    assert sim.contact_forces[0, 1, 2] > 0.0
    numeric = []
    for row in np.eye(2 * nv):
        (q_1, v_1), (q_0, v_0) = after(h * row), after(-h * row)
        change = difference(robot, q_1, middle) - difference(robot, q_0, middle)
        numeric.append(np.concatenate([change, v_1 - v_0]) / (2 * h))
    derivatives.restore(start)
    slopes = derivatives.linearize(target)[0][0]
    np.testing.assert_allclose(slopes, np.array(numeric).T, atol=1e-6 * np.abs(slopes).max())
    found = derivatives.gradient(target, {"q": np.ones((1, nv)), "v": np.ones((1, nv))})
    np.testing.assert_allclose(np.concatenate([found["q"][0], found["v"][0]]), slopes.sum(0), atol=1e-9)
