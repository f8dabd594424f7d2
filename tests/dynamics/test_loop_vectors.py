"""Closed loops against the paper authors' C++ library, on its own random states, tests/data/vectors.

The robots are made from the published figures. Tello's published coordinates are its rotor angles; ours are usually
link angles, so it is compared both ways: positions and velocities by name, forces by `tau = W^T tau_rotors`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from facts import load_facts, robot_from_facts

from ce_gym.dynamics import Model

DATA = Path(__file__).parents[1] / "data" / "vectors"
TOLERANCE = 1e-9
LINKS = [f"{side}-{link}" for side in ("left", "right") for link in ("hip-clamp", "gimbal", "thigh", "shin", "foot")]
CASES = {
    "four_bar": ("four_bar", None),
    "planar_leg_linkage": ("planar_leg_linkage", None),
    "parallel_implicit_d5_l5": ("parallel_implicit_d5_l5", None),
    "parallel_explicit_d5_l4": ("parallel_explicit_d5_l4", None),
    "bench_four_bar_b2_d2": ("bench_four_bar_b2_d2", None),
    "tello, link angles": ("tello", LINKS),
    "tello, rotor angles": ("tello", None),
}


class Reference:
    """Reference states, each with a model that is assembled like it."""

    def __init__(self, name: str, independent: list[str] | None) -> None:
        data = json.loads((DATA / f"{name}.json").read_text())
        facts = load_facts(name)
        self.free = facts["base"] == "floating"
        self.theirs = [c for cluster in facts["clusters"] for c in cluster["constraint"].get("independent", [])]
        self.order = [joint for joint in data["spanning_joint_order"] if joint != self.base(facts)]
        self.name, self.independent, self.models, self.states = name, independent, [], []
        for state in data["states"][:8]:
            self.states.append((state, *self.assembled_like(state)))

    def base(self, facts: dict) -> str | None:
        return facts["bodies"][0]["name"] if self.free else None

    def by_name(self, spanning: list[float], base: int) -> dict[str, float]:
        return dict(zip(self.order, spanning[base if self.free else 0 :], strict=True))

    def assembled_like(self, state: dict) -> tuple[Model, np.ndarray, np.ndarray]:
        """Return a model on the branch of a state, and the state in its coordinates."""
        angles, rates = self.by_name(state["q_span"], 7), self.by_name(state["v_span"], 6)
        for attempt in (False, True):
            if attempt:
                self.models.append(Model(robot_from_facts(self.name, self.independent, angles)))
            for model in self.models:
                q = np.array([*(state["q_span"][:7] if self.free else []), *(angles[j] for j in model.joint_links)])
                v = np.array([*(state["v_span"][:6] if self.free else []), *(rates[j] for j in model.joint_links)])
                offset = 7 if self.free else 0
                found = dict(zip(model.spanning_names, model.spanning(q, v)[0][offset:], strict=True))
                if all(abs(np.exp(1j * found[j]) - np.exp(1j * angles[j])) < 1e-6 for j in self.order):
                    return model, q, v
        raise AssertionError(f"{self.name}: a model does not assemble like the state it was made from")

    def forces(self, model: Model, q: np.ndarray, theirs: list[float]) -> np.ndarray:
        """Take forces on the published coordinates to ours."""
        base = 6 if self.free else 0
        tau = model.actuator_matrix(q, self.theirs).T @ np.array(theirs)[base:]
        tau[:base] += theirs[:base]
        return tau


@pytest.fixture(scope="module", params=CASES)
def reference(request: pytest.FixtureRequest) -> Reference:
    return Reference(*CASES[request.param])


def assert_close(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert np.abs(ours - theirs).max() <= TOLERANCE * max(1.0, np.abs(theirs).max())


def spanning(reference: Reference, model: Model, ours: np.ndarray) -> np.ndarray:
    """Our spanning velocities or accelerations in the published order, without bodies that are ours alone."""
    base = 6 if reference.free else 0
    values = dict(zip(model.spanning_names, ours[base:], strict=True))
    return np.array([*ours[:base], *(values[joint] for joint in reference.order)])


def test_velocities(reference: Reference):
    for state, model, q, v in reference.states:
        assert_close(spanning(reference, model, model.spanning(q, v)[1]), np.array(state["v_span"]))


def test_forward_dynamics_and_spanning_accelerations(reference: Reference):
    for state, model, q, v in reference.states:
        vdot = model.forward_dynamics(q, v, reference.forces(model, q, state["tau"]))
        assert_close(spanning(reference, model, model.spanning_acceleration(q, v, vdot)), np.array(state["qdd_span"]))


def test_external_wrenches(reference: Reference):
    for state, model, q, v in reference.states:
        if "f_ext" not in state:  # the vectors of the benchmark chains have none
            assert reference.name in ("parallel_implicit_d5_l5", "parallel_explicit_d5_l4", "bench_four_bar_b2_d2")
            continue
        wrenches = {each["body"]: np.array(each["wrench_world_origin"]) for each in state["f_ext"]}
        vdot = model.forward_dynamics(q, v, reference.forces(model, q, state["tau"]), wrenches)
        W = model.actuator_matrix(q, reference.theirs)
        g = model.spanning_acceleration(q, v, 0 * vdot)
        rows = {name: i for i, name in enumerate(model.spanning_names)}
        base = 6 if reference.free else 0
        theirs = np.array([g[base + rows[joint]] for joint in reference.theirs]) + W @ vdot
        assert_close(np.concatenate([vdot[:base], theirs]), np.array(state["ydd_f_ext"]))


def test_inverse_dynamics(reference: Reference):
    for state, model, q, v in reference.states:
        base = 6 if reference.free else 0
        W = model.actuator_matrix(q, reference.theirs)
        rows = {name: i for i, name in enumerate(model.spanning_names)}
        g = model.spanning_acceleration(q, v, np.zeros(model.nv))
        target = np.array(state["id_ydd"]) - np.concatenate(
            [np.zeros(base), [g[base + rows[j]] for j in reference.theirs]]
        )
        G = np.vstack([np.eye(model.nv)[:base], W])  # published velocities from ours
        tau = model.inverse_dynamics(q, v, np.linalg.solve(G, target))
        assert_close(tau, reference.forces(model, q, state["id_tau"]))


def test_mass_matrix_and_bias(reference: Reference):
    for state, model, q, _ in reference.states[:3]:
        base = 6 if reference.free else 0
        G = np.vstack([np.eye(model.nv)[:base], model.actuator_matrix(q, reference.theirs)])
        if "H" in state:
            assert_close(model.mass_matrix(q), G.T @ np.array(state["H"]) @ G)


def test_loops_are_closed(reference: Reference):
    for _, model, q, _ in reference.states:
        assert model.loop_gap(q) <= 1e-13
