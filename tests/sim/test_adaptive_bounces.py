"""Steps that adapt where contacts begin and end: bounces of any loss, against an integrator that stops at events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from ce_gym import Model, Simulator
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Robot

Array = NDArray[np.float64]
GRAVITY, DURATION, RADIUS, SLIP_SPEED = 9.81, 0.4, 0.05, 0.05


@dataclass
class Bounces:
    """Bodies of one kilogram that fall in the plane of x and z, so that stiffnesses stand for other masses, too.

    Attributes:
        inertia: Of a body [kg m^2].
        spheres: Where its contact spheres are along its x axis [m].
        dissipation: Of Hunt and Crossley's law [s/m]; None for Kelvin and Voigt's.
        k: Stiffnesses [N/m], shape (n,).
        c: Dampings of Kelvin and Voigt's law [N s/m], shape (n,).
        mu: Coefficients of friction, shape (n,).
        start: x, z, angle about y and their velocities [m, rad], shape (n, 6).
    """

    inertia: float
    spheres: tuple[float, ...]
    dissipation: float | None
    k: Array
    c: Array
    mu: Array
    start: Array

    def place(self, i: int, state: Array) -> tuple[Array, Array, Array, Array]:
        """Return x of spheres from the centre of mass, depths, and normal and tangential velocities of their points."""
        _, z, angle, vx, vz, w = state
        x, height = np.array(self.spheres) * np.cos(angle), -np.array(self.spheres) * np.sin(angle)
        return x, RADIUS - z - height, vz - w * x, vx + w * (height - RADIUS)

    def rate(self, i: int, state: Array, touching: NDArray[np.bool_]) -> Array:
        """Return the rate of a state, given which spheres are in the ground."""
        x, depth, normal, slip = self.place(i, state)
        if self.dissipation is None:
            load = self.k[i] * depth - self.c[i] * normal
        else:
            load = self.k[i] * depth * np.maximum(1 - self.dissipation * normal, 0)
        load = np.where(touching, np.maximum(load, 0), 0)
        friction = -self.mu[i] * load * np.clip(slip / SLIP_SPEED, -1, 1)
        torque = np.sum(-(state[1] + depth) * friction - x * load)
        return np.array([*state[3:], friction.sum(), load.sum() - GRAVITY, torque / self.inertia])

    def end(self, i: int) -> Array:
        """Return a state after `DURATION`, by DOP853 from event to event."""
        time, state = 0.0, self.start[i]
        touching = self.place(i, state)[1] > 0
        while time < DURATION:
            events = []
            for j, inside in enumerate(touching):

                def depth(_: float, s: Array, j: int = j) -> float:
                    return self.place(i, s)[1][j]

                depth.terminal, depth.direction = True, -1 if inside else 1  # type: ignore[attr-defined]
                events.append(depth)
            result = solve_ivp(
                lambda _, s, touching=touching: self.rate(i, s, touching),
                (time, DURATION),
                state,
                "DOP853",
                events=events,
                max_step=0.4 / np.sqrt(self.k[i]) if touching.any() else np.inf,
                first_step=min(1e-8, DURATION - time),
                rtol=1e-9,
                atol=1e-11,
            )
            time, state = result.t[-1], result.y[:, -1]
            touching = touching ^ np.array([len(times) > 0 for times in result.t_events])
        return state

    def simulator(self, tolerance: float) -> Simulator:
        """Return a simulator of all bodies at the start."""
        inertia = tuple(tuple(row) for row in self.inertia * np.eye(3))
        body = Body("body", "link", None, Placement(), Joint("free"), Inertial(1.0, (0.0, 0.0, 0.0), inertia))  # type: ignore[arg-type]
        contacts = tuple(ContactSphere(f"sphere_{x}", "body", (x, 0.0, 0.0), RADIUS) for x in self.spheres)
        material = ContactMaterial(slip_speed=SLIP_SPEED, bristle=0.0, dissipation=self.dissipation)
        figures = {"stiffness": self.k, "friction": self.mu} | ({} if self.dissipation else {"damping": self.c})
        model, options = Model(Robot("body", (body,), contacts=contacts, material=material)), {"outputs": ()}
        options |= {"method": "adaptive", "tolerance": tolerance, "parameters": tuple(figures)}
        sim = Simulator(model, len(self.k), 0.02, **options)  # type: ignore[arg-type]
        for name, values in figures.items():
            sim.set_parameter(name, values[:, None])
        x, z, angle, vx, vz, w = self.start.T
        still, cos, sin = np.zeros_like(x), np.cos(angle), np.sin(angle)
        q = np.stack([x, still, z, np.cos(angle / 2), still, np.sin(angle / 2), still], axis=1)
        sim.set_state(q, np.stack([still, w, still, cos * vx - sin * vz, still, sin * vx + cos * vz], axis=1))
        return sim


def bounces(kind: str) -> Bounces:
    """Return random bounces: of a ball straight down, of one with speed, spin and friction, or of a rod."""
    rod, oblique = kind == "rod", kind != "straight"
    n = 2 if rod else 8
    rng = np.random.default_rng(len(kind))
    k, height = 10 ** rng.uniform(4, 6, n), rng.uniform(0.02, 0.3, n)
    c = 2 * np.sqrt(k) * np.where(rng.random(n) < 0.2, 0.0, rng.uniform(0.01, 1.0, n))
    angle, w = rng.uniform(-0.4, 0.4, n) * rod, rng.uniform(-1, 1, n) * oblique * (2 if rod else 20)
    z = RADIUS + height + 0.2 * np.abs(np.sin(angle)) * rod
    start = np.stack([0 * k, z, angle, rng.uniform(-2, 2, n) * oblique, 0 * k, w], axis=1)
    mu = rng.uniform(0, 1, n) * oblique
    return Bounces(0.01 if rod else 1e-3, (-0.2, 0.2) if rod else (0.0,), None, k, c, mu, start)


@pytest.mark.parametrize(
    ("kind", "dissipation"),
    [("straight", None), ("straight", 0.03), ("oblique", None), ("oblique", 0.5), ("rod", None)],
)
def test_bounces_are_within_thirty_times_the_tolerance(kind: str, dissipation: float | None):
    """Restitution from 0 to 1, by Kelvin and Voigt's law with a jump of force at touch-down and by Hunt and Crossley's.

    Bodies that are not within it are counted as missed, and few are.
    """
    case = bounces(kind)
    case.dissipation = dissipation
    expected = np.array([case.end(i) for i in range(len(case.k))])
    for tolerance in (1e-3, 1e-4, 1e-5):
        sim = case.simulator(tolerance)
        sim.step(np.zeros(0), 20)
        turned = 2 * np.arctan2(sim.q[:, 5], sim.q[:, 3]) - expected[:, 2]
        turned -= 2 * np.pi * np.round(turned / (2 * np.pi))
        error = np.abs(np.stack([*(sim.q[:, [0, 2]] - expected[:, :2]).T, turned])).max(axis=0)
        missed = sim.steps.missed > 0
        assert (error[~missed] < 30 * tolerance).all(), (tolerance, error[~missed].max())
        assert missed.mean() <= 0.2
