"""Every quantity of every reference file of the paper authors' C++ library, tests/data/vectors.

Robots are taken from wherever the package has them: its own files, the authors' URDF+ files, the rules that make the
scaling chains, and the published figures for robots that it does not ship. The library's own algorithms agree to 2e-12
at worst on these states, so 1e-9 is the bar everywhere. It is needed next to singularities of small loops, where the
library's positions have an error of 1e-12; robots with formulas far from that, or gears only, are held to 1e-12.
Errors are relative to the largest entry of a state, or to 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from facts import robot_from_facts
from vectors import DATA, FILES, Group, Vectors

from ce_gym.bench import chains
from ce_gym.dynamics import Model
from ce_gym.model import Robot, load_robot

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")

URDF_PLUS = Path(__file__).parents[1] / "data" / "urdf_plus"
NEAR_SINGULARITIES = ("four_bar", "planar_leg_linkage", "bench_four_bar_b2_d2")


@dataclass(frozen=True)
class Case:
    """A file, how to make its robot, and whether symmetric rotors are eliminated."""

    file: str
    make: Callable[[], Robot]
    eliminate: bool = True

    @property
    def tolerance(self) -> float:
        return 1e-9 if self.file in NEAR_SINGULARITIES else 1e-12


def ours(name: str, file: str | None = None) -> dict[str, Case]:
    return {f"{file or name}, our file": Case(file or name, lambda: load_robot(name))}


def urdf_plus(name: str, file: str | None = None) -> dict[str, Case]:
    path = URDF_PLUS / f"{name}.urdf"
    return {f"{file or name}, URDF+": Case(file or name, lambda: load_robot(path))}


def rule(make: Callable[[int, int], Robot], file: str, *size: int) -> dict[str, Case]:
    return {f"{file}, rule": Case(file, lambda: make(*size))}


def figures(name: str) -> dict[str, Case]:
    return {f"{name}, figures": Case(name, lambda: robot_from_facts(name))}


CASES = {
    **ours("mini_cheetah"),
    **ours("mit_humanoid"),
    **ours("mit_humanoid_leg"),
    **ours("mit_humanoid_leg", "mit_humanoid_leg_urdf"),
    **ours("jvrc1", "jvrc1_symmetric"),
    **ours("tello"),  # our coordinates are link angles, the library's are rotor angles
    **ours("four_bar"),
    **ours("planar_leg_linkage"),
    **urdf_plus("mini_cheetah"),
    **urdf_plus("mit_humanoid_leg"),
    **urdf_plus("mit_humanoid_leg", "mit_humanoid_leg_urdf"),
    **urdf_plus("four_bar"),
    **rule(chains.link_and_rotor_chain, "bench_revolute_rotor_b2_d3", 2, 3),
    **rule(chains.belt_pair_chain, "bench_revolute_rotor_pair_b2_d2", 2, 2),
    **rule(chains.four_bar_chain, "bench_four_bar_b2_d2", 2, 2),
    **rule(chains.transmission_parallel_chain, "parallel_explicit_d5_l4", 5, 4),
    **rule(chains.transmission_parallel_chain, "parallel_explicit_d10_l12", 10, 12),
    **rule(chains.rod_parallel_chain, "parallel_implicit_d5_l5", 5, 5),
    **figures("jvrc1"),
    **figures("tello"),
    **figures("bench_four_bar_b2_d2"),
    **figures("parallel_implicit_d5_l5"),
    **figures("revolute_rotor_chain_4"),
    **figures("revolute_rotor_chain_urdf"),
    **figures("revolute_rotor_pair_chain_4"),
    **figures("random_revolute_rotor_chain_4"),
    **figures("random_revolute_rotor_pair_chain_4"),
}
GENERAL = [  # also with every rotor a body
    *("mit_humanoid, our file", "jvrc1_symmetric, our file", "mini_cheetah, our file"),
    *("mit_humanoid_leg, our file", "tello, our file", "tello, figures"),
    *("random_revolute_rotor_pair_chain_4, figures", "bench_revolute_rotor_b2_d3, rule"),
    *("bench_revolute_rotor_pair_b2_d2, rule", "parallel_explicit_d5_l4, rule"),
]
CASES |= {f"{name}, general": replace(CASES[name], eliminate=False) for name in GENERAL}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


@pytest.fixture(scope="module")
def vectors(case: Case) -> Vectors:
    return Vectors(case.file, case.make, case.eliminate)


def assert_close(case: Case, ours: np.ndarray, theirs: np.ndarray) -> None:
    """Compare states, each relative to its own largest entry."""
    assert ours.shape == theirs.shape
    for mine, reference in zip(ours, theirs, strict=True):
        error = np.abs(mine - reference).max(initial=0.0)
        assert error <= case.tolerance * max(1.0, np.abs(reference).max(initial=0.0))


def transposed(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return np.einsum("nij,ni->nj", matrices, vectors)


def published_acceleration(group: Group, vdot: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", group.T, vdot) + group.t


def our_acceleration(group: Group, ydd: np.ndarray) -> np.ndarray:
    return np.linalg.solve(group.T, (ydd - group.t)[..., None])[..., 0]


def test_every_file_is_here():
    assert {case.file for case in CASES.values()} == set(FILES)


@pytest.mark.slow
def test_every_quantity_is_known(vectors: Vectors):
    """A quantity that is not on this list would not be compared."""
    compared = {"q_span", "v_span", "yd", "tau", "ydd", "qdd_span", "id_ydd", "id_tau", "bias", "g_span", "cond_H", "H"}
    compared |= {"implicit", "contact_pos", "contact_vel", "contact_acc", "contact_jac_world", "bodies", "f_ext"}
    for state in vectors.states:
        assert state.keys() <= compared | {"ydd_f_ext", "agreement_abs"}
    assert len(vectors.states) == sum(len(group.states) for group in vectors.groups) == 10
    clusters = [{vectors.names[body] for body in cluster["bodies"]} for cluster in vectors.data["clusters"]]
    known = set().union(*clusters)  # cranks are ours alone
    for model in vectors.models:
        found = [{body for body in cluster.bodies if body in known} for cluster in model.cluster_tree.clusters]
        assert sorted(map(sorted, found)) == sorted(map(sorted, clusters))


def test_velocities_and_positions(case: Case, vectors: Vectors):
    for group in vectors.groups:
        q_span, v_span = group.model.spanning(group.q, group.v)
        assert_close(case, v_span[:, group.columns], vectors["v_span"][group.states])
        base = 1 if vectors.free else 0
        ours = q_span[:, [*range(7 if base else 0), *(i + base for i in group.columns[6 if base else 0 :])]]
        turns = np.round((vectors["q_span"][group.states] - ours) / (2 * np.pi))
        assert group.model.loop_report() or not turns.any()  # a formula may be whole turns away
        assert_close(case, ours + 2 * np.pi * turns, vectors["q_span"][group.states])
        assert_close(case, np.einsum("nij,nj->ni", group.T, group.v), vectors["yd"][group.states])


@pytest.mark.slow
def test_forward_dynamics(case: Case, vectors: Vectors):
    for group in vectors.groups:
        tau = transposed(group.T, vectors["tau"][group.states])
        vdot = group.model.forward_dynamics(group.q, group.v, tau)
        assert_close(case, published_acceleration(group, vdot), vectors["ydd"][group.states])
        ours = group.model.spanning_acceleration(group.q, group.v, vdot)[:, group.columns]
        assert_close(case, ours, vectors["qdd_span"][group.states])


def test_inverse_dynamics(case: Case, vectors: Vectors):
    for group in vectors.groups:
        vdot = our_acceleration(group, vectors["id_ydd"][group.states])
        tau = group.model.inverse_dynamics(group.q, group.v, vdot)
        assert_close(case, tau, transposed(group.T, vectors["id_tau"][group.states]))


def test_bias_force(case: Case, vectors: Vectors):
    if vectors.is_short("bias"):
        return
    for group in vectors.groups:
        tau = group.model.inverse_dynamics(group.q, group.v, our_acceleration(group, 0 * group.t))
        theirs = transposed(group.T, vectors["bias"][group.states])
        assert_close(case, tau, theirs)
        if not group.t.any():
            assert_close(case, group.model.bias_force(group.q, group.v), theirs)


def test_mass_matrix(case: Case, vectors: Vectors):
    H = vectors["H"]
    if vectors.is_short("H"):
        return
    assert len(H) >= 5
    for group in vectors.groups:
        inverse = np.linalg.inv(group.T)
        ours = np.einsum("nki,nkl,nlj->nij", inverse, group.model.mass_matrix(group.q), inverse)
        there = [i for i, state in enumerate(group.states) if state < len(H)]
        assert_close(case, ours[there], H[[group.states[i] for i in there]])
        condition = np.linalg.cond(ours)
        np.testing.assert_allclose(condition, vectors["cond_H"][group.states], rtol=1e-9)


def test_constraints(case: Case, vectors: Vectors):
    """`g` of all joints; and where the library has K, k, G and g of a cluster, those are ours."""
    if vectors.is_short("g_span"):
        return
    clusters = {cluster["name"]: cluster for cluster in vectors.data["clusters"]}
    for group in vectors.groups:
        G, g = group.model.explicit_constraint(group.q, group.v)
        K, k = group.model.implicit_constraint(group.q, group.v)
        at = our_acceleration(group, 0 * group.t)
        g_theirs = (np.einsum("nij,nj->ni", G, at) + g)[:, group.columns]
        assert_close(case, g_theirs, vectors["g_span"][group.states])
        G_theirs = G @ np.linalg.inv(group.T)
        for i, state in enumerate(group.states):
            for each in vectors.states[state].get("implicit", ()):
                cluster = clusters[each["cluster"]]
                theirs = vectors.data["spanning_joint_order"]
                offset = 5 if vectors.free else 0
                rows = [group.columns[offset + theirs.index(body)] for body in cluster["bodies"]]
                independent = range(*cluster["v_ind"])
                assert_close(case, G_theirs[i][np.ix_(rows, independent)], np.array(each["G"]))
                assert_close(case, (G[i] @ at[i] + g[i])[rows][None], np.array(each["g"])[None])
                spread = np.zeros((len(each["K"]), len(g[i])))
                spread[:, rows] = each["K"]
                # their rows are sums of ours, and so are the right-hand sides
                size = np.linalg.norm(K[i], axis=1)
                sums = np.linalg.lstsq((K[i] / size[:, None]).T, spread.T, rcond=None)[0].T
                assert_close(case, sums @ (K[i] / size[:, None]), spread)
                assert_close(case, (sums @ (k[i] / size))[None], np.array(each["k"])[None])


def test_bodies(case: Case, vectors: Vectors):
    if vectors.is_short("bodies"):
        return
    for group in vectors.groups:
        positions, rotations = group.model.body_poses(group.q)
        angular, linear = group.model.body_velocities(group.q, group.v)
        for i, state in enumerate(group.states):
            bodies = vectors.states[state].get("bodies", [])
            rows = [group.model.body_names.index(vectors.names[body["body"]]) for body in bodies]
            for ours, key in ((positions, "p"), (rotations, "R"), (linear, "v"), (angular, "w")):
                assert_close(case, ours[i, rows], np.array([body[key] for body in bodies]).reshape(ours[i, rows].shape))


def test_external_wrenches(case: Case, vectors: Vectors):
    if vectors.is_short("ydd_f_ext"):
        return
    for group in vectors.groups:
        tau = transposed(group.T, vectors["tau"][group.states])
        wrenches = {name: np.zeros((len(group.states), 6)) for name in group.model.body_names}
        for i, state in enumerate(group.states):
            for each in vectors.states[state]["f_ext"]:
                wrenches[vectors.names[each["body"]]][i] += each["wrench_world_origin"]
        assert any(wrench.any() for wrench in wrenches.values())
        vdot = group.model.forward_dynamics(group.q, group.v, tau, wrenches)
        assert_close(case, published_acceleration(group, vdot), vectors["ydd_f_ext"][group.states])


def test_contact_points(case: Case, vectors: Vectors):
    if vectors.is_short("contact_pos"):
        return
    shape = (10, len(vectors.robot.contacts), 3)  # of no points too
    reference = {key: vectors[f"contact_{key}"].reshape(shape) for key in ("pos", "vel", "acc")}
    for group in vectors.groups:
        vdot = our_acceleration(group, vectors["ydd"][group.states])
        positions, velocities = group.model.contact_points(group.q, group.v)
        assert_close(case, positions, reference["pos"][group.states])
        assert_close(case, velocities, reference["vel"][group.states])
        accelerations = group.model.contact_accelerations(group.q, group.v, vdot)
        assert_close(case, accelerations, reference["acc"][group.states])
        if 0 in group.states:
            i, units = group.states.index(0), np.eye(group.model.nv)
            carriers = [group.model.body_names.index(contact.body) for contact in vectors.robot.contacts]
            turning = group.model.body_velocities(group.q[i], units)[0][:, carriers]
            moving = group.model.contact_points(group.q[i], units)[1]
            ours = np.moveaxis(np.concatenate([turning, moving], axis=-1), 0, -1) @ np.linalg.inv(group.T[i])
            assert_close(case, ours, vectors["contact_jac_world"][0].reshape(shape[1], 6, group.model.nv))


def test_tracking_of_a_sinusoid():
    """The file ankle_tracking.json: torques of the leg at three levels along the paper's experiment."""
    data = json.loads((DATA / "ankle_tracking.json").read_text())
    t = np.array([sample["t"] for sample in data["samples_every_500"]])[:, None]
    A, w, each = data["A"], data["omega_rad_s"], np.ones((1, 5))
    states = A * np.sin(w * t) * each, A * w * np.cos(w * t) * each, -A * w**2 * np.sin(w * t) * each
    levels = {"exact": "exact", "diag": "armature", "none": "none"}
    models = {key: Model("mit_humanoid_leg", level, locked_rotors=False) for key, level in levels.items()}
    torques = {key: model.inverse_dynamics(*states) for key, model in models.items()}
    for key, ours in torques.items():
        theirs = np.array([sample[key] for sample in data["samples_every_500"]])
        assert np.abs(ours - theirs).max() <= 1e-12 * np.abs(theirs).max()
    block = models["diag"].mass_matrix(np.zeros(5)) - models["none"].mass_matrix(np.zeros(5))
    np.testing.assert_allclose(block, np.diag(np.diag(data["reflected_inertia_block"])), atol=1e-14)
    coupled = Model("mit_humanoid_leg", "coupled", locked_rotors=False).mass_matrix(np.zeros(5))
    difference = coupled - models["none"].mass_matrix(np.zeros(5))
    np.testing.assert_allclose(difference, data["reflected_inertia_block"], atol=1e-14)
