"""Boxes as feet against what rigid bodies do: on a slope, tipping, and pivoting about an edge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import load_robot
from ce_gym.sim import Simulator

G, MASS, WIDTH, HEIGHT, DT = 9.81, 2.0, 0.2, 0.2, 0.002
INERTIA = MASS * (WIDTH**2 + HEIGHT**2) / 12
URDF = f"""<robot name="block"><link name="block">
<inertial><mass value="{MASS}"/>
<inertia ixx="{INERTIA}" iyy="{INERTIA}" izz="{INERTIA}" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size="{WIDTH} {WIDTH} {HEIGHT}"/></geometry></collision>
</link></robot>"""


@pytest.fixture(scope="module")
def blocks(tmp_path_factory) -> Simulator:
    """Blocks that may differ in which way they fall and how they rub: one kernel for all tests."""
    folder: Path = tmp_path_factory.mktemp("block")
    (folder / "block.urdf").write_text(URDF)
    (folder / "block.yaml").write_text(
        f"urdf: block.urdf\nbase: floating\ncontacts: {{block: {{body: block, shape: collision}}}}\n"
        f"pose: {{height: {HEIGHT / 2}}}\n"
    )
    model = Model(load_robot(folder / "block.yaml"))
    assert len(model.contact_names) == 8
    return Simulator(model, 5, DT, parameters=("gravity", "friction"), outputs=("contact_forces",))


def on_slopes(sim: Simulator, angles, friction: float, tilt: float = 0.0) -> None:
    """Put blocks on planes inclined along x, as seen from these, tilted about their lower edges."""
    angle = np.broadcast_to(np.asarray(angles, dtype=float), sim.num_envs)
    sim.set_parameter("gravity", G * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], 1))
    sim.set_parameter("friction", friction)
    q = np.zeros(7)
    depth = MASS * G / (4 - 2 * bool(tilt)) / sim.model.robot.material.stiffness
    q[2] = HEIGHT / 2 * np.cos(tilt) + WIDTH / 2 * np.sin(abs(tilt)) - depth
    q[3], q[5] = np.cos(tilt / 2), np.sin(tilt / 2)
    sim.set_state(q, np.zeros(6))


def test_a_block_slides_beyond_the_angle_of_friction(blocks: Simulator):
    """With g (sin - mu cos); below it stays where it is."""
    mu = 0.3
    angles = np.arctan(mu) + np.radians([-3.0, -0.5, 0.5, 3.0, 10.0])
    on_slopes(blocks, angles, mu)
    blocks.step(np.zeros(0), 200)
    before = blocks.v[:, 3].copy()
    blocks.step(np.zeros(0), 100)
    acceleration = (blocks.v[:, 3] - before) / (100 * DT)
    expected = G * np.maximum(np.sin(angles) - mu * np.cos(angles), 0)
    np.testing.assert_allclose(acceleration, expected, atol=2e-3 * G)
    assert (np.abs(blocks.v[:2]) < 1e-6).all()


def test_a_block_tips_where_gravity_leaves_its_base(blocks: Simulator):
    """At atan(width / height): 45 degrees."""
    angles = np.arctan(WIDTH / HEIGHT) + np.radians([-3.0, -1.0, -0.3, 0.3, 1.0])
    on_slopes(blocks, angles, 3.0)
    blocks.step(np.zeros(0), 600)
    tilt = 2 * np.arcsin(np.clip(blocks.q[:, 5], -1, 1))
    assert (np.abs(tilt[:3]) < 0.01).all()
    assert (np.abs(tilt[3:]) > 0.5).all()


def test_a_block_pivots_about_its_edge(blocks: Simulator):
    """As a pendulum upside down: I psi'' = m g r sin(psi) about the edge, psi from the vertical."""
    tilt, n, refined = np.radians(25.0), 60, 10
    on_slopes(blocks, 0.0, 3.0, tilt=tilt)
    r, about_edge = np.hypot(WIDTH, HEIGHT) / 2, INERTIA + MASS * (WIDTH**2 + HEIGHT**2) / 4
    psi, rate = np.arctan(WIDTH / HEIGHT) - tilt, 0.0
    for _ in range(refined * n):
        rate += DT / refined * MASS * G * r / about_edge * np.sin(psi)
        psi += DT / refined * rate
    blocks.step(np.zeros(0), n)
    np.testing.assert_allclose(-blocks.v[:, 1], rate, rtol=2e-3)
    np.testing.assert_allclose(np.arctan(WIDTH / HEIGHT) - 2 * np.arcsin(blocks.q[:, 5]), psi, rtol=1e-2)
