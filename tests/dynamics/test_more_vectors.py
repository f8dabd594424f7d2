"""Humanoids against the paper authors' C++ library, tests/data/vectors, and standing on their own feet.

The library is compared with at both ways of treating rotors: eliminated, or every one a body.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.sim import Simulator

DATA = Path(__file__).parents[1] / "data" / "vectors"
TOLERANCE = 1e-10
VECTORS = {"mit_humanoid": "mit_humanoid", "jvrc1": "jvrc1_symmetric"}

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


class Reference:
    """States of one file; its independent velocities are in the order of its clusters, which must be ours."""

    def __init__(self, model: Model) -> None:
        data = json.loads((DATA / f"{VECTORS[model.robot.name]}.json").read_text())
        self.states, self.bodies = data["states"], data["spanning_joint_order"][1:]
        theirs = [set(cluster["bodies"]) for cluster in data["clusters"]]
        assert theirs == [set(cluster.bodies) for cluster in model.cluster_tree.clusters]
        self.q = self.spanning("q_span", 7, model.joint_links)

    def __getitem__(self, key: str) -> np.ndarray:
        return np.array([state[key] for state in self.states if key in state])

    def spanning(self, key: str, base: int, names: tuple[str, ...]) -> np.ndarray:
        """The base's entries and those of the bodies `names`."""
        return self[key][:, [*range(base), *(base + self.bodies.index(name) for name in names)]]


def relative_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    assert ours.shape == theirs.shape
    return float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))


@pytest.fixture(scope="module", params=[True, False], ids=["eliminated", "general"])
def eliminate(request: pytest.FixtureRequest) -> bool:
    return request.param


@pytest.fixture(scope="module", params=list(VECTORS))
def model(request: pytest.FixtureRequest, eliminate: bool) -> Model:
    return Model(request.param, eliminate_rotors=eliminate)


@pytest.fixture(scope="module")
def reference(model: Model) -> Reference:
    return Reference(model)


def test_there_are_states_to_compare(reference: Reference):
    assert len(reference.q) >= 10
    assert len(reference["H"]) >= 5


def test_forward_dynamics(model: Model, reference: Reference):
    ours = model.forward_dynamics(reference.q, reference["yd"], reference["tau"])
    assert relative_error(ours, reference["ydd"]) <= TOLERANCE


def test_inverse_dynamics(model: Model, reference: Reference):
    ours = model.inverse_dynamics(reference.q, reference["yd"], reference["id_ydd"])
    assert relative_error(ours, reference["id_tau"]) <= TOLERANCE


def test_mass_matrix(model: Model, reference: Reference):
    theirs = reference["H"]
    assert relative_error(model.mass_matrix(reference.q[: len(theirs)]), theirs) <= TOLERANCE


def test_bias_force(model: Model, reference: Reference):
    assert relative_error(model.bias_force(reference.q, reference["yd"]), reference["bias"]) <= TOLERANCE


def test_spanning_coordinates(model: Model, reference: Reference):
    q_span, v_span = model.spanning(reference.q, reference["yd"])
    assert relative_error(q_span, reference.spanning("q_span", 7, model.spanning_names)) <= TOLERANCE
    assert relative_error(v_span, reference.spanning("v_span", 6, model.spanning_names)) <= TOLERANCE


def test_body_poses(model: Model, reference: Reference):
    states = [state for state in reference.states if "bodies" in state]
    positions, rotations = model.body_poses(reference.q[: len(states)])
    for i, state in enumerate(states):
        rows = [model.body_names.index(body["body"]) for body in state["bodies"]]
        assert sorted(rows) == list(range(len(model.body_names)))
        assert relative_error(positions[i, rows], np.array([body["p"] for body in state["bodies"]])) <= TOLERANCE
        assert relative_error(rotations[i, rows], np.array([body["R"] for body in state["bodies"]])) <= TOLERANCE


def test_rotors_are_eliminated(model: Model, eliminate: bool):
    """All rotors of the one robot are symmetric about their axes; of the other only those about z."""
    rotors = {rotor.name for rotor in model.robot.rotors()}
    assert rotors & set(model.mechanism.bodies) == (set() if eliminate else rotors)
    lopsided = [spin.rotor for spins in model.mechanism.spins for spin in spins if spin.transverse > 0.0]
    assert len(lopsided) == (18 if model.robot.name == "jvrc1" and eliminate else 0)


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
@pytest.mark.parametrize("name", ["mit_humanoid"])
def test_robot_stands_for_three_seconds(name: str):
    """With its own gains, on its soles only, at rest, near its standing pose."""
    model = Model(name)
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
