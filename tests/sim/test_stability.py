"""Stability over many steps: nothing gains energy, nothing creeps, nothing rattles, nothing far away is felt."""

from __future__ import annotations

import numpy as np
import pytest
import small_mechanisms as mechanisms
from tripod import TRIPOD

from ce_gym import Model, Simulator
from ce_gym.bench.stability import grid
from ce_gym.model import ContactMaterial


@pytest.fixture(scope="module")
def cheetah() -> Model:
    return Model("mini_cheetah")


@pytest.mark.parametrize("method", ["euler", "extrapolated", "adaptive"])
@pytest.mark.parametrize("robot", ["block", "tripod"])
def test_contacts_never_pull(robot: str, method: str):
    """Robots at rest that are set in upward motion fly away; thrown robots, some in the ground, are only pushed."""
    model, n, rng = Model(mechanisms.block() if robot == "block" else TRIPOD), 24, np.random.default_rng(1)
    sim = Simulator(model, n, method=method, outputs=("contact_forces", "energy"))
    target, up = model.standing_q[7:], np.zeros(model.nv)
    sim.step(target, 200)
    up[5] = 1.0
    sim.set_state(sim.q, up)
    sim.step(target)
    np.testing.assert_allclose(sim.v[:, 5], 1.0 - 9.81 * sim.dt, atol=0.02)
    q = np.tile(model.standing_q, (n, 1))
    q[:, 2] += rng.uniform(-0.1, 0.2, n)
    q[:, 3:7] = rng.normal(size=(n, 4))
    q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    sim.set_state(q, rng.normal(0, 1.5, (n, model.nv)))
    sim.step(target)
    touched = 0
    for _ in range(60):
        before = sim.energy
        sim.step(target)
        assert sim.contact_forces[..., 2].min() >= -1e-5
        touched += sim.contact_forces.any(axis=(1, 2)).sum()
        if robot == "block" and method == "euler":
            assert (sim.energy <= before + 1e-9 * np.abs(before)).all()
    assert touched > n
    assert not sim.diverged.any()


@pytest.mark.slow
def test_a_chain_of_many_rods_swings():
    """For half a second from horizontal, on undamped joints: Euler's gain of energy stays below a tenth of its fall."""
    n = 40
    sim = mechanisms.simulator(mechanisms.chain(n), 0.002, outputs=())
    q = np.zeros(n)
    q[:2] = np.pi / 2
    sim.set_state(q, np.zeros(n))
    start, lowest = (float(np.sum(sim.model.energy(x, np.zeros(n)))) for x in (q, np.zeros(n)))
    for _ in range(25):
        sim.step(np.zeros(n), 10)
        assert np.sum(sim.model.energy(sim.q[0], sim.v[0])) - start < 0.1 * (start - lowest)
    assert np.abs(sim.v).max() > 1.0


@pytest.mark.slow
def test_standing_for_a_minute(cheetah: Model):
    sim = Simulator(cheetah, 1, 0.005, outputs=())
    sim.step(cheetah.standing_q[7:], 12_000)
    settled = sim.q[0].copy()
    for _ in range(6):
        sim.step(cheetah.standing_q[7:], 2000)
        np.testing.assert_allclose(sim.q[0], settled, rtol=0, atol=1e-6)
        assert np.abs(sim.v).max() < 1e-12


def test_a_base_at_fifty_radians_per_second(cheetah: Model):
    """Spun about eight axes through its centre of mass, 1 ms: the energy of the turning does not rise."""
    sim, n = Simulator(cheetah, 8, 0.001, contacts=(), outputs=()), 8
    axes = np.random.default_rng(0).normal(size=(n, 3))
    v = np.zeros((n, cheetah.nv))
    v[:, :3] = 50.0 * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    M = cheetah.mass_matrix(cheetah.standing_q)
    centre_of_mass = np.array([M[2, 4], M[0, 5], M[1, 3]]) / M[3, 3]
    v[:, 3:6] = np.cross(centre_of_mass, v[:, :3])
    sim.set_state(cheetah.standing_q, v)
    start = cheetah.energy(sim.q, sim.v)[0]
    for i in range(100):
        sim.step(cheetah.standing_q[7:], 100)
        falling = cheetah.total_mass * (9.81 * 0.1 * (i + 1)) ** 2 / 2
        assert (cheetah.energy(sim.q, sim.v)[0] - falling <= start).all()
    assert not sim.diverged.any()


@pytest.mark.slow
@pytest.mark.parametrize(("dt", "most"), [(0.001, 1e-9), (0.002, 1e-3), (0.02, 0.2)])
def test_a_robot_without_motors_never_gains_energy(cheetah: Model, dt: float, most: float):
    """On ground of any stiffness and slip speed; with the energy of its springs and stops, if the step resolves them.

    Its stops swing once in 7 to 11 ms.
    """
    finite, gain, excess, *_ = grid.fall(cheetah, dt, 1.5)
    assert finite.all()
    assert (excess <= 0).all()
    resolved = np.array(grid.STIFFNESSES) * dt**2 <= 0.5  # stiffer than that, half a kilogram bounces within a step
    assert (gain[resolved] <= most).all()


@pytest.mark.slow
def test_a_robot_that_stands_is_silent(cheetah: Model):
    """At the coarsest step, on ground of any stiffness and slip speed; on the softest it rocks for a minute."""
    finite, speed = grid.stand(cheetah, 0.02, 120.0)
    assert finite.all()
    assert (speed <= 1e-6).all()


@pytest.mark.slow
def test_random_torques_lose_no_robot():
    """Up to the limits of the motors, held for four steps; light shanks without rotors turn a radian in a step."""
    model = Model("mini_cheetah", "none")
    sim = Simulator(model, 2000, 0.005, control="torque", outputs=())
    limits = np.array([model.robot.body(joint).joint.torque for joint in model.joint_links])
    rng = np.random.default_rng(0)
    for _ in range(13):
        sim.step(rng.uniform(-1.0, 1.0, (2000, len(limits))) * limits, 4)
    assert not sim.diverged.any()


@pytest.mark.parametrize("method", ["euler", "extrapolated"])
def test_contacts_in_the_air_do_nothing(method: str):
    """Far above the ground a robot moves as one that has no contacts, to the last digits."""
    model, rng = Model(TRIPOD), np.random.default_rng(0)
    q, v = np.tile(model.standing_q, (8, 1)), rng.normal(0, 3, (8, model.nv))
    q[:, 2] += 50.0
    target = model.standing_q[7:] + rng.normal(0, 0.3, (8, 2))
    with_contacts, without = (Simulator(model, 8, contacts=c, method=method) for c in ("all", ()))
    for sim in (with_contacts, without):
        sim.set_state(q, v)
    for _ in range(200):
        with_contacts.step(target)
        assert not with_contacts.contact_forces.any()
    without.step(target, 200)
    np.testing.assert_allclose(with_contacts.v, without.v, rtol=0, atol=1e-9)


def test_a_corner_that_is_hit_second_is_seen():
    """Blocks land on one edge, which throws the other one down within the step; from heights a part of a step apart."""
    n, half = 16, 0.15
    sim = mechanisms.simulator(mechanisms.block(stiffness=1e6, damping=1e3), 0.01, n)
    q = np.tile([0.0, 0.0, 0.0, np.cos(half), 0.0, np.sin(half), 0.0], (n, 1))
    q[:, 2] = np.linspace(0.1, 0.13, n)
    sim.set_state(q, [0.0, 0.0, 0.0, 0.0, 0.0, -3.0])
    deepest = 0.0
    for _ in range(60):
        sim.step(np.zeros(0))
        centres, _ = sim.model.contact_points(sim.q, np.zeros((n, 6)))
        deepest = max(deepest, float((0.01 - centres[..., 2]).max()))
    assert deepest < 2e-3


@pytest.mark.slow
def test_slip_speed_differs_from_robot_to_robot():
    robot = mechanisms.block(pull=1.2 * 0.5 * 9.81)
    together = Simulator(Model(robot), 2, 0.004, control="torque", parameters=("slip_speed",))
    together.set_parameter("slip_speed", [[1e-3], [1e-1]])
    together.step(np.zeros(0), 25)
    for i, slip_speed in enumerate((1e-3, 1e-1)):
        material = ContactMaterial(**(vars(robot.material) | {"slip_speed": slip_speed}))
        alone = Simulator(Model(robot), 1, 0.004, control="torque", material=material)
        alone.step(np.zeros(0), 25)
        np.testing.assert_allclose(together.q[i], alone.q[0], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_energy_is_what_moves_falls_and_is_bent(cheetah: Model):
    """On its springs, which carry its weight: half a square of the weight over the stiffness, and no more."""
    sim = mechanisms.simulator(mechanisms.block(), 0.01)
    sim.step(np.zeros(0), 2000)
    weight, k = 10.0 * 9.81, mechanisms.GROUND.stiffness
    expected = weight * (0.05 - weight / (4 * k)) + weight**2 / (8 * k)
    assert sim.energy[0] == pytest.approx(expected, rel=1e-9)
    held = Simulator(cheetah, 1, contacts=(), outputs=("energy",))
    held.step(cheetah.standing_q[7:] + 0.1)
    kinetic, potential = cheetah.energy(held.q[0], held.v[0])
    gains = np.array([dict(cheetah.robot.gains.kp)[name] for name in cheetah.joint_links])
    spring = float(gains @ (cheetah.standing_q[7:] + 0.1 - held.q[0, 7:]) ** 2) / 2
    assert held.energy[0] == pytest.approx(float(kinetic + potential) + spring, rel=1e-9)
