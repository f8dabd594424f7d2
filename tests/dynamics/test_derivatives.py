"""Derivatives of the dynamics against complex steps, against Pinocchio, and identities between them."""

from __future__ import annotations

from pathlib import Path

import complex_step
import numpy as np
import pytest
from linkages import rod_leg, spatial_four_bar
from tripod import TRIPOD

from ce_gym.dynamics import Model
from ce_gym.model import Robot
from ce_gym.model.mechanism import LEVELS

EXACT = [TRIPOD, "tello", "planar_leg_linkage", rod_leg(), spatial_four_bar()]
CASES = [("mit_humanoid_leg", level) for level in LEVELS] + [(robot, "exact") for robot in EXACT]


def near_standing(model: Model, count: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random positions around the standing pose, velocities and forces or accelerations."""
    rng = np.random.default_rng(3)
    q = model.standing_q + rng.uniform(-0.15, 0.15, (count, model.nq))
    if model.robot.floating:
        q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
    return q, rng.normal(0, 2, (count, model.nv)), rng.normal(0, 5, (count, model.nv))


def assert_close(ours: np.ndarray, theirs: np.ndarray, tolerance: float = 1e-10) -> None:
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * max(1.0, np.abs(theirs).max()))


def by_complex_steps(model: Model, name: str, *state: np.ndarray) -> list[np.ndarray]:
    """Jacobians of the first output of a quantity with respect to its inputs, at one state."""
    function = model.casadi_function(name)
    arguments = [*state, *([model.dependent_guess(state[0])] if "guess" in function.name_in() else [])]
    directions = [complex_step.tangents(state[0], model.robot.floating), *[np.eye(len(x)) for x in state[1:]]]
    return [complex_step.jacobian(function, arguments, i, along)[0] for i, along in enumerate(directions)]


@pytest.mark.parametrize(("robot", "level"), CASES, ids=lambda x: Path(x).stem if isinstance(x, str) else x.name)
def test_against_complex_steps(robot: str | Robot, level: str):
    model = Model(robot, level)
    state = near_standing(model)
    for name, derivatives in (
        ("forward_dynamics", model.forward_dynamics_derivatives(*state)),
        ("inverse_dynamics", model.inverse_dynamics_derivatives(*state)),
    ):
        for i in range(len(state[0])):
            expected = by_complex_steps(model, name, *[x[i] for x in state])
            for ours, theirs in zip(derivatives, expected, strict=True):
                assert_close(ours[i], theirs)


@pytest.mark.parametrize("robot", [TRIPOD, spatial_four_bar()], ids=["tripod", "spatial_four_bar"])
def test_identities(robot: str | Robot):
    model = Model(robot)
    q, v, tau = near_standing(model)
    dq, dv, dtau = model.forward_dynamics_derivatives(q, v, tau)
    vdot = model.forward_dynamics(q, v, tau)
    tau_q, tau_v, M = model.inverse_dynamics_derivatives(q, v, vdot)
    assert_close(M, model.mass_matrix(q))
    assert_close(dtau, np.swapaxes(dtau, 1, 2), 0.0)
    assert_close(dtau @ M, np.broadcast_to(np.eye(model.nv), M.shape))
    assert_close(M @ dq, -tau_q)
    assert_close(M @ dv, -tau_v)


def test_products_are_the_jacobian_s():
    model = Model("planar_leg_linkage")
    state, rng = near_standing(model), np.random.default_rng(0)
    wrt = ("q", "tau", "rotor_inertia")
    derivatives = model.derivatives("forward_dynamics", wrt)
    jacobian = derivatives.jacobian(*state)
    directions = {x: rng.normal(size=jacobian["vdot", x].shape[::2]) for x in wrt}
    weights = rng.normal(size=state[1].shape)
    along = sum(np.einsum("nij,nj->ni", jacobian["vdot", x], directions[x]) for x in wrt)
    assert_close(derivatives.product(*state, directions=directions)["vdot"], along)
    gradient = derivatives.gradient(*state, weights={"vdot": weights})
    for x in wrt:
        assert_close(gradient[x], np.einsum("nij,ni->nj", jacobian["vdot", x], weights))


def test_energy_s_gradient_is_gravity_and_momentum():
    model = Model("mit_humanoid_leg")
    q, v, _ = near_standing(model)
    jacobian = model.derivatives("energy", ("q", "v")).jacobian(q, v)
    gravity = model.bias_force(q, np.zeros_like(v))
    assert_close(jacobian["potential", "q"][:, 0], gravity)
    assert_close(jacobian["kinetic", "v"][:, 0], np.einsum("nij,nj->ni", model.mass_matrix(q), v))


@pytest.mark.parametrize(
    ("name", "figure", "size"),
    [(TRIPOD, "rotor_inertia", 1), (TRIPOD, "ratio", 1), ("planar_leg_linkage", "gravity", 3)],
)
def test_figures_against_changed_robots(name: str, figure: str, size: int):
    """Against robots with another figure, by Richardson's rule: gravity enters linearly, rotors through J r^2."""
    import casadi as ca

    from ce_gym.dynamics.functions import FUNCTIONS
    from ce_gym.dynamics.laws.scene_parameters import parameter_defaults
    from ce_gym.dynamics.parameters import with_parameters

    model = Model(name)
    q, v, tau = (x[0] for x in near_standing(model))
    (default,) = parameter_defaults(model.robot, model.robot.material, (figure,)).values()

    def at(value: np.ndarray) -> np.ndarray:
        changed = with_parameters(model.mechanism, {figure: ca.SX(ca.DM(value))})
        return FUNCTIONS["forward_dynamics"](changed)(q, v, tau).full()[:, 0]

    columns = []
    for direction in np.eye(size):
        difference = [(at(default + h * direction) - at(default - h * direction)) / (2 * h) for h in (1e-2, 5e-3)]
        columns.append((4 * difference[1] - difference[0]) / 3)
    ours = model.derivatives("forward_dynamics", (figure,)).jacobian(q, v, tau)["vdot", figure]
    assert_close(ours, np.array(columns).T, 1e-7)


def test_against_pinocchio():
    pin = pytest.importorskip("pinocchio")
    from ce_gym.bench.peers.pinocchio import load

    model = Model("mini_cheetah", "armature", eliminate_rotors=False)
    peer = load(model.robot)
    data = peer.model.createData()
    rows = peer.accelerations(np.arange(peer.model.nv)).astype(int)  # where each of our coordinates is
    for q, v, tau in zip(*near_standing(model), strict=True):
        theirs = pin.computeABADerivatives(
            peer.model, data, peer.positions(q), peer.velocities(v), peer.velocities(tau)
        )
        for ours, other in zip(model.forward_dynamics_derivatives(q, v, tau), theirs, strict=True):
            assert_close(ours, np.asarray(other)[np.ix_(rows, rows)])


def test_what_cannot_be_differentiated_is_said():
    model = Model("planar_leg_linkage")
    with pytest.raises(ValueError, match="derivatives: no function 'jump'; expected one of forward_dynamics"):
        model.derivatives("jump", ["q"])
    with pytest.raises(ValueError, match="derivatives of mass_matrix: wrt='v'; expected some of q, gravity"):
        model.derivatives("mass_matrix", ["v"])
    with pytest.raises(ValueError, match="with respect to nothing"):
        model.derivatives("mass_matrix", [])
