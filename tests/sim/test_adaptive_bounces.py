"""Steps that adapt where contacts begin and end: bounces of any loss, against an integrator that stops at events."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ce_gym import Model, Simulator
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot

GRAVITY, DURATION, RADIUS, ENVS = 9.81, 0.4, 0.05, 48
INERTIA = ((1e-3, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3))


def ball(**material) -> Model:
    """One kilogram."""
    body = Body("ball", "link", None, Placement(), Joint("free"), Inertial(1.0, (0.0, 0.0, 0.0), INERTIA))
    contacts = (ContactSphere("ball", "ball", (0.0, 0.0, 0.0), RADIUS),)
    return Model(Robot("ball", (body,), contacts=contacts, material=ContactMaterial(friction=0.0, **material)))


def bounced(height: float, k: float, c: float) -> float:
    """Height after a time, by DOP853 from surface to surface; in the ground it may push again after a release."""

    def surface(_: float, s: np.ndarray) -> float:
        return s[0]

    surface.terminal = True  # type: ignore[attr-defined]
    time, state, inside = 0.0, np.array([height, 0.0]), False
    while time < DURATION:
        surface.direction = 1 if inside else -1  # type: ignore[attr-defined]
        force = (lambda z, v: max(-k * z - c * v, 0.0)) if inside else (lambda z, v: 0.0)
        result = solve_ivp(
            lambda _, s, force=force: [s[1], force(*s) - GRAVITY],
            (time, DURATION),
            state,
            "DOP853",
            events=surface,
            max_step=0.2 / np.sqrt(k) if inside else np.inf,
            first_step=1e-7,
            rtol=1e-11,
            atol=1e-13,
        )
        time, state, inside = result.t[-1], result.y[:, -1], not inside
    return float(state[0])


@pytest.mark.parametrize("seed", [0, 1])
def test_bounces_are_within_thirty_times_the_tolerance_or_counted_as_missed(seed: int):
    """Kelvin and Voigt's law with a jump of force at touch-down, restitution from 0 to 1, up to three bounces.

    Stiffnesses and dampings are for one kilogram, so that the ranges stand for other masses, too.
    """
    rng = np.random.default_rng(seed)
    k, heights = 10 ** rng.uniform(4, 6, ENVS), rng.uniform(0.02, 0.3, ENVS)
    c = 2 * np.sqrt(k) * np.where(rng.random(ENVS) < 0.2, 0.0, rng.uniform(0.01, 1.0, ENVS))
    expected = np.array([bounced(*each) for each in zip(heights, k, c, strict=True)])
    for tolerance in (1e-3, 1e-4, 1e-5):
        options = {"method": "adaptive", "tolerance": tolerance, "parameters": ("stiffness", "damping")}
        sim = Simulator(ball(), ENVS, 0.02, outputs=(), **options)
        sim.set_parameter("stiffness", k[:, None])
        sim.set_parameter("damping", c[:, None])
        q = np.tile([0.0, 0.0, RADIUS, 1.0, 0.0, 0.0, 0.0], (ENVS, 1))
        q[:, 2] += heights
        sim.set_state(q, np.zeros((ENVS, 6)))
        sim.step(np.zeros(0), 20)
        error, missed = np.abs(sim.q[:, 2] - RADIUS - expected), sim.steps.missed > 0
        assert (error[~missed] < 30 * tolerance).all(), (tolerance, error[~missed].max())
        assert missed.mean() < {1e-3: 0.1, 1e-4: 0.4, 1e-5: 0.9}[tolerance]


def test_hunt_and_crossley_without_dissipation_bounces_as_a_spring():
    material = {"stiffness": 1e5, "damping": 0.0, "dissipation": 0.0}
    sim = Simulator(ball(**material), 16, 0.02, method="adaptive", tolerance=1e-4, outputs=())
    heights = np.linspace(0.1, 0.3, 16)
    q = np.tile([0.0, 0.0, RADIUS, 1.0, 0.0, 0.0, 0.0], (16, 1))
    q[:, 2] += heights
    sim.set_state(q, np.zeros((16, 6)))
    sim.step(np.zeros(0), 20)
    expected = np.array([bounced(height, 1e5, 0.0) for height in heights])
    assert np.abs(sim.q[:, 2] - RADIUS - expected).max() < 30e-4
