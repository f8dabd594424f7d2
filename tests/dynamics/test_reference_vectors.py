"""Every quantity of the paper authors' C++ library on its own random states, tests/data/vectors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import Robot

DATA = Path(__file__).parents[1] / "data" / "vectors"
TOLERANCE = 1e-12


class Reference:
    """Reference states of one robot in the order of our coordinates."""

    def __init__(self, robot: Robot, model: Model) -> None:
        data = json.loads((DATA / f"{robot.name}.json").read_text())
        self.states = data["states"]
        self.spanning_order = data["spanning_joint_order"]
        base = 7 if robot.floating else 0
        joints = [name for name in self.spanning_order if robot.body(name).joint.type != "free"]
        clusters = [cluster for cluster in data["clusters"] if robot.body(cluster["bodies"][0]).joint.type != "free"]
        assert len(clusters) == len(model.cluster_tree.clusters) - robot.floating
        columns = list(range(base)) + [base + joints.index(name) for name in model.joint_links]
        self.q = self["q_span"][:, columns]
        self.v = self["yd"]

    def __getitem__(self, key: str) -> np.ndarray:
        return np.array([state[key] for state in self.states if key in state])

    def spanning(self, model: Model, key: str, base: int) -> np.ndarray:
        """Spanning quantities, in the order of our bodies."""
        floating = [name for name in self.spanning_order if model.robot.body(name).joint.type == "free"]
        joints = [name for name in self.spanning_order if name not in floating]
        offset = base if floating else 0
        columns = list(range(offset)) + [offset + joints.index(name) for name in model.spanning_names]
        return self[key][:, columns]


def relative_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))


@pytest.fixture(params=[True, False], ids=["eliminated", "general"])
def model(request: pytest.FixtureRequest, robot: Robot) -> Model:
    return Model(robot, eliminate_rotors=request.param)


@pytest.fixture
def reference(robot: Robot, model: Model) -> Reference:
    return Reference(robot, model)


def test_there_are_states_to_compare(reference: Reference):
    assert len(reference.q) >= 10
    assert len(reference["H"]) >= 5


def test_forward_dynamics(model: Model, reference: Reference):
    assert (
        relative_error(model.forward_dynamics(reference.q, reference.v, reference["tau"]), reference["ydd"]) < TOLERANCE
    )


def test_inverse_dynamics(model: Model, reference: Reference):
    ours = model.inverse_dynamics(reference.q, reference.v, reference["id_ydd"])
    assert relative_error(ours, reference["id_tau"]) < TOLERANCE


def test_mass_matrix(model: Model, reference: Reference):
    theirs = reference["H"]
    assert relative_error(model.mass_matrix(reference.q[: len(theirs)]), theirs) < TOLERANCE


def test_bias_force(model: Model, reference: Reference):
    assert relative_error(model.bias_force(reference.q, reference.v), reference["bias"]) < TOLERANCE


def test_spanning_coordinates(model: Model, reference: Reference):
    q_span, v_span = model.spanning(reference.q, reference.v)
    assert relative_error(q_span, reference.spanning(model, "q_span", 7)) < TOLERANCE
    assert relative_error(v_span, reference.spanning(model, "v_span", 6)) < TOLERANCE


def test_body_poses(model: Model, reference: Reference):
    positions, rotations = model.body_poses(reference.q[:2])
    for i, state in enumerate(reference.states[:2]):
        for body in state["bodies"]:
            row = model.body_names.index(body["body"])
            np.testing.assert_allclose(positions[i, row], body["p"], atol=1e-12)
            np.testing.assert_allclose(rotations[i, row], body["R"], atol=1e-12)
