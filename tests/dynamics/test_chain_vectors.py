"""The library's uniform and random chains and the published JVRC-1, on every reference state, from figures alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from facts import robot_from_facts

from ce_gym.dynamics import Model

DATA = Path(__file__).parents[1] / "data" / "vectors"
TOLERANCE = 1e-10
CHAINS = [
    "revolute_rotor_chain_4",
    "revolute_rotor_chain_urdf",
    "revolute_rotor_pair_chain_4",
    "random_revolute_rotor_chain_4",
    "random_revolute_rotor_pair_chain_4",
    "jvrc1",
]


class Chain:
    """A model made from published figures, and reference states in its coordinates."""

    def __init__(self, name: str) -> None:
        self.model = Model(robot_from_facts(name))
        data = json.loads((DATA / f"{name}.json").read_text())
        self.states = data["states"]
        base = 7 if self.model.robot.floating else 0
        joints = [j for j in data["spanning_joint_order"] if self.model.robot.body(j).joint.type != "free"]
        self.q = self["q_span"][:, [*range(base), *(base + joints.index(j) for j in self.model.joint_links)]]
        offset = 6 if base else 0
        self.spanning = [*range(offset), *(offset + joints.index(j) for j in self.model.spanning_names)]
        self.v = self["yd"]

    def __getitem__(self, key: str) -> np.ndarray:
        return np.array([state[key] for state in self.states if key in state])


@pytest.fixture(scope="module", params=CHAINS)
def chain(request: pytest.FixtureRequest) -> Chain:
    return Chain(request.param)


def assert_close(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert len(theirs) >= 5
    assert np.abs(ours - theirs).max() <= TOLERANCE * max(1.0, np.abs(theirs).max())


def test_accelerations(chain: Chain):
    vdot = chain.model.forward_dynamics(chain.q, chain.v, chain["tau"])
    assert_close(vdot, chain["ydd"])
    assert_close(chain.model.spanning_acceleration(chain.q, chain.v, vdot), chain["qdd_span"][:, chain.spanning])


def test_forces(chain: Chain):
    assert_close(chain.model.inverse_dynamics(chain.q, chain.v, chain["id_ydd"]), chain["id_tau"])
    assert_close(chain.model.bias_force(chain.q, chain.v), chain["bias"])
    H = chain["H"]
    assert_close(chain.model.mass_matrix(chain.q[: len(H)]), H)


def test_poses(chain: Chain):
    positions, rotations = chain.model.body_poses(chain.q[:2])
    for i, state in enumerate(chain.states[:2]):
        for body in state["bodies"]:
            row = chain.model.body_names.index(body["body"])
            np.testing.assert_allclose(positions[i, row], body["p"], atol=1e-11)
            np.testing.assert_allclose(rotations[i, row], body["R"], atol=1e-11)
