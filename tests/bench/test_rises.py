"""What adds to the energy in a step, against figures that follow from the scheme of the step for one degree of freedom.

There the motion loses half of m dv^2, whatever the force; and a spring and damper taken one step ahead lose half of
k dx^2 and c v^2 dt.
"""

from __future__ import annotations

import numpy as np

from ce_gym.bench.stability import scenes
from ce_gym.bench.stability.rises import SOURCES, Largest, sources
from ce_gym.dynamics.forces.passive import stop_springs
from ce_gym.dynamics.model import Model
from ce_gym.model import Body, ContactSphere, Joint, Placement, Robot
from ce_gym.sim import Simulator

DT = 0.004


def step(model: Model, q, v, torque: float = 0.0) -> tuple[Largest, np.ndarray]:
    """Return one step as `Largest`, which takes it whatever it does to the energy, and the energy after it."""
    sim = Simulator(model, 1, DT, control="torque", outputs=("energy", "contact_forces"))
    sim.set_state(q, v)
    before = sim.snapshot()
    largest = Largest.none(before, sim.contact_forces)
    sim.step(np.full(len(model.joint_links), torque))
    largest.take(7, np.ones(1), before, sim.snapshot(), sim.contact_forces)
    return largest, sim.energy


def test_a_ball_that_lands():
    model = Model(scenes.ball())
    depth, speed, k, c = 0.002, -1.3, scenes.GROUND.stiffness, scenes.GROUND.damping
    q = model.standing_q - [0, 0, depth, 0, 0, 0, 0]
    largest, energy = step(model, q, [0.0, 0.0, 0.0, 0.0, 0.0, speed])
    after = float(largest.after["v"][0, 5])
    largest.rise = energy - np.sum(model.energy(q, [0, 0, 0, 0, 0, speed])) - k * depth**2 / 2
    added = dict(zip(SOURCES, sources(model, largest, np.array([k]), DT)[0], strict=True))
    np.testing.assert_allclose(added["motion"], -((after - speed) ** 2) / 2, rtol=1e-9)
    np.testing.assert_allclose(added["springs"], -k * (DT * after) ** 2 / 2 - c * after**2 * DT, rtol=1e-9)
    assert abs(added["bristles"]) + abs(added["stops"]) < 1e-12
    assert largest.step == 7


def test_a_bristle_that_is_bent():
    """Sticking at rest: the damper of the bristle has the slope mu N / v_s."""
    model, ground = Model(scenes.ball()), scenes.GROUND
    q = model.standing_q - [0, 0, scenes.GRAVITY / ground.stiffness, 0, 0, 0, 0]
    largest, _ = step(model, q, [0.0, 0.0, 0.0, 1e-4, 0.0, 0.0])
    v = largest.after["v"][0]
    slip = v[3] - 0.1 * v[1]
    damped = ground.friction * scenes.GRAVITY / ground.slip_speed * slip**2 * DT
    added = dict(zip(SOURCES, sources(model, largest, np.array([ground.stiffness]), DT)[0], strict=True))
    np.testing.assert_allclose(added["bristles"], -damped - ground.bristle * (DT * slip) ** 2 / 2, rtol=1e-6)


def test_a_stop_acts_by_the_velocity_at_the_start():
    link = Body("link", "link", None, Placement(), Joint("prismatic", (1, 0, 0), position=(-0.1, 0.1)),
                scenes.inertial(2.0, (0.1, 0.1, 0.1)))  # fmt: skip
    foot = ContactSphere("foot", "link", (0.0, 0.0, 1.0), 0.1)  # in the air
    model = Model(Robot("slider", (link,), (), ("link",), (foot,), gravity=(0.0, 0.0, 0.0)))
    k, c = stop_springs(model.mechanism)["link"]
    for start, torque in ((0.05, 0.0), (-0.3, 400.0)):  # deeper; out of it, but for a force that turns it round
        largest, _ = step(model, [0.101], [start], torque)
        after = float(largest.after["v"][0, 0])
        added = sources(model, largest, np.zeros(1), DT)[0, SOURCES.index("stops")]
        pushed = -k * (DT * after) ** 2 / 2 - c * after**2 * DT
        left = k * (max(0.101 + DT * after - 0.1, 0.0) ** 2 - 0.001**2) / 2
        np.testing.assert_allclose(added, pushed if start > 0 else left, rtol=1e-9)
