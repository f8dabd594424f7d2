"""Cylinders that roll: down slopes as rigid bodies do, on and on where it is level, on a field as on a plane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym import Terrain
from ce_gym.dynamics import Model
from ce_gym.dynamics.forces.ground import above_deepest, reach
from ce_gym.model import load_robot
from ce_gym.model.frames import rotation_matrix
from ce_gym.sim import Simulator

G, MASS, RADIUS, LENGTH, DT = 9.81, 2.0, 0.1, 0.08, 0.002
SOLID, HOOP = 0.5 * MASS * RADIUS**2, MASS * RADIUS**2
NOTHING = np.zeros(0)


def cylinder(folder: Path, moment: float, how: str) -> Model:
    """One that lies across x, free to roll along it."""
    (folder / "roller.urdf").write_text(
        f'<robot name="roller"><link name="roller"><inertial><mass value="{MASS}"/><inertia ixx="0.01" iyy="{moment}" '
        'izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    shape = f"{{body: roller, shape: cylinder, size: [{RADIUS}, {LENGTH}], rpy: [1.5707963267948966, 0, 0], {how}}}"
    (folder / "roller.yaml").write_text(
        f"urdf: roller.urdf\nbase: floating\ncontacts: {{wheel: {shape}}}\npose: {{height: {RADIUS}}}\n"
    )
    return Model(load_robot(folder / "roller.yaml"))


def resting(model: Model, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """On level ground, loaded by its weight, rolling at a speed."""
    depth = MASS * G / 2 / model.robot.material.stiffness
    return np.array([0, 0, RADIUS - depth, 1.0, 0, 0, 0]), np.array([0, speed / RADIUS, 0, speed, 0, 0])


def speed_of(sim: Simulator) -> np.ndarray:
    """In the world [m/s], shape (n, 3)."""
    return np.stack([rotation_matrix(q[3:7]) @ v[3:6] for q, v in zip(sim.q, sim.v, strict=True)])


@pytest.mark.parametrize(("moment", "share"), [(SOLID, 2 / 3), (HOOP, 1 / 2)], ids=["solid", "hoop"])
def test_it_rolls_down_a_slope(tmp_path, moment: float, share: float):
    """With g sin(alpha) / (1 + I / (m r^2)), to the 1e-4 by which the smooth rim is off."""
    sim = Simulator(cylinder(tmp_path, moment, "rolls: true"), 3, DT, parameters=("gravity",))
    angle = np.radians([3.0, 8.0, 15.0])
    sim.set_parameter("gravity", G * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], 1))
    sim.set_state(*resting(sim.model, 0.0))
    sim.step(NOTHING, 100)
    before = speed_of(sim)
    sim.step(NOTHING, 250)
    acceleration = (speed_of(sim) - before)[:, 0] / (250 * DT)
    np.testing.assert_allclose(acceleration, share * G * np.sin(angle), rtol=2e-4)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_it_rolls_down_a_field(tmp_path, dtype: str):
    """Of which each rim meets the plane under it: downhill from where it is put, without a jump."""
    angle = 0.25
    terrain = Terrain.slope(-angle)
    sim = Simulator(cylinder(tmp_path, SOLID, "rolls: true"), 1, DT, terrain=terrain, dtype=dtype)
    z = float(terrain.at(0.0, 0.0)[0])
    assert sim.q[0, 2] - z == pytest.approx(RADIUS / np.cos(angle), rel=1e-3)
    sim.step(NOTHING, 100)
    before = speed_of(sim)
    sim.step(NOTHING, 250)
    gained = (speed_of(sim) - before)[0] / (250 * DT)
    expected = 2 / 3 * G * np.sin(angle) * np.array([np.cos(angle), 0, -np.sin(angle)])
    np.testing.assert_allclose(gained, expected, atol=5e-3 * np.linalg.norm(expected))


def test_it_keeps_its_speed_and_a_polygon_does_not(tmp_path):
    """Of 1 m/s less than 3e-5 are gone after 5 s, all as it settles; an octagon has lost nine tenths in one."""
    left = {}
    for how, seconds in (("rolls: true", 5), ("rim: 8, face: +z", 1)):
        sim = Simulator(cylinder(tmp_path, SOLID, how), 1, DT)
        sim.set_state(*resting(sim.model, 1.0))
        sim.step(NOTHING, round(seconds / DT))
        left[how] = float(np.linalg.norm(speed_of(sim)[0]))
    assert 1 - left["rolls: true"] == pytest.approx(1.7e-5, abs=1.3e-5)
    assert left["rim: 8, face: +z"] < 0.1


def test_force_and_depth_are_of_one_potential():
    """How fast the depth of a rim grows is the speed of its deepest point into the ground, flat or leaning."""
    q, w = np.random.default_rng(0).normal(size=(2, 40, 4))
    q[:5] = [1.0, 0.0, 0.0, 0.0] + 0.005 * q[:5]  # nearly flat
    axis, up, h = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), 1e-6
    for quaternion, rate in zip(q, w[:, :3], strict=True):
        a = rotation_matrix(quaternion / np.linalg.norm(quaternion)) @ axis
        turned = h * np.cross(rate, a)
        grown = (reach(0.02, 0.1, a + turned) - reach(0.02, 0.1, a - turned)) / (2 * h)
        down = np.cross(rate, -above_deepest(0.02, 0.1, up, a, a[2])) @ -up
        assert grown == pytest.approx(down, abs=1e-8)
