"""Humanoids: which rotors are eliminated, what exactness costs, and standing on their own feet."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.sim import Simulator

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


@pytest.mark.parametrize(("name", "lopsided"), [("mit_humanoid", 0), ("jvrc1", 18)])
def test_rotors_are_eliminated(name: str, lopsided: int):
    """All rotors of the one robot are symmetric about their axes; of the other only those about z."""
    special, general = Model(name), Model(name, eliminate_rotors=False)
    rotors = {rotor.name for rotor in special.robot.rotors()}
    assert rotors & set(special.mechanism.bodies) == set()
    assert rotors <= set(general.mechanism.bodies)
    eliminated = [rotor for rotors in special.mechanism.eliminated_rotors for rotor in rotors]
    assert sum(rotor.transverse > 0.0 for rotor in eliminated) == lopsided


def n_instructions(name: str, transmission: str) -> int:
    return Model(name, transmission).n_instructions("forward_dynamics")


def test_exactness_is_cheap_where_rotors_are_symmetric():
    """At most 1.10 times the armature level, and 0.45 of the library's 21 115 instructions (CasADi 3.8.2)."""
    exact = n_instructions("mit_humanoid", "exact")
    assert exact <= 1.10 * n_instructions("mit_humanoid", "armature")
    assert exact <= 0.45 * 21115


def test_exactness_is_cheap_where_rotors_are_not_symmetric():
    """At most 0.45 of the library's 27 534 instructions (CasADi 3.8.2)."""
    assert n_instructions("jvrc1", "exact") <= 0.45 * 27534


@pytest.mark.slow
def test_a_humanoid_stands_for_three_seconds():
    """With its own gains, on its soles only, at rest, near its standing pose."""
    model = Model("mit_humanoid")
    simulator = Simulator(model, 1, dt=0.005)
    target, weight = model.standing_q[7:], 9.81 * model.total_mass
    groups = [contact.group for contact in model.robot.contacts]
    for _ in range(30):
        simulator.step(target, n_substeps=20)
        touching = {groups[i] for i in np.flatnonzero(np.abs(simulator.contact_forces[0]).max(axis=1))}
        assert touching == {"foot"}
    (q,), (v,) = simulator.q, simulator.v
    assert not simulator.diverged.any()
    assert q[2] == pytest.approx(model.standing_q[2], abs=0.01)
    assert np.linalg.norm(q[4:6]) < np.sin(np.radians(3) / 2)
    assert np.abs(q[7:] - target).max() < 0.1
    assert np.abs(v).max() < 0.02
    assert simulator.contact_forces[0, :, 2].sum() == pytest.approx(weight, rel=0.01)
    limits = np.array([model.robot.body(joint).joint.torque for joint in model.joint_links])
    assert (np.abs(simulator.torque[0]) < 0.5 * limits).all()
