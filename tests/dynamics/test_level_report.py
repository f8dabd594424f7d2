"""The report on levels: worst cases that some motion attains and none exceeds, and figures from the dynamics alone."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.__main__ import main
from ce_gym.diagnostics.levels import (
    compare_levels,
    flight_inertia,
    foot_jacobian,
    foot_masses,
    level_row,
    levels_report,
    natural_frequencies,
    verdict,
)
from ce_gym.dynamics import Model
from ce_gym.model.mechanism import LEVELS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
CHEETAH = {level: Model("mini_cheetah", level) for level in ("exact", "armature")}


def test_no_motion_of_the_leg_is_worse_than_the_worst_case():
    """Torques come from inverse dynamics at rest, less gravity; the norm is the kinetic energy."""
    leg = {level: Model("mit_humanoid_leg", level) for level in LEVELS}
    exact, q = leg["exact"], leg["exact"].standing_q
    still, rng = np.zeros(5), np.random.default_rng(0)
    M = {level: one.mass_matrix(q)[None] for level, one in leg.items()}
    row = level_row(exact, "armature", M, np.zeros((1, 0, 5)))
    modes = np.linalg.eig(np.linalg.solve(M["exact"], M["armature"]))[1][0].real.T
    vdot = np.concatenate([rng.normal(size=(20_000, 5)), modes])
    at, rest = np.tile(q, (len(vdot), 1)), np.zeros_like(vdot)
    torque = {level: one.inverse_dynamics(at, rest, vdot) - one.bias_force(q, still) for level, one in leg.items()}
    chol = np.linalg.cholesky(np.linalg.inv(M["exact"][0]))
    size = {"exact": torque["exact"] @ chol, "error": (torque["armature"] - torque["exact"]) @ chol}
    share = np.linalg.norm(size["error"], axis=1) / np.linalg.norm(size["exact"], axis=1)
    assert share.max() == pytest.approx(row.torque.median, rel=1e-9)
    assert 0.5 * share.max() < share[:-5].max() <= share.max() * (1 + 1e-9)
    assert row.base_turn is None
    assert row.foot_mass is None


def test_inertia_in_flight_and_mass_of_a_foot_are_those_of_forward_dynamics():
    model = CHEETAH["exact"]
    q, v = model.standing_q, np.zeros(18)
    M = model.mass_matrix(q)[None]
    H, turn = flight_inertia(M, 6)
    bias = model.bias_force(q, v)
    push = np.random.default_rng(1).normal(size=12)
    vdot = model.forward_dynamics(q, v, bias + np.concatenate([np.zeros(6), push]))
    np.testing.assert_allclose(H[0] @ vdot[6:], push, atol=1e-9)
    np.testing.assert_allclose(turn[0] @ vdot[6:], vdot[:6], atol=1e-9)
    feet = foot_jacobian(model, q[None])
    assert feet.shape == (1, 4, 18)
    struck = model.forward_dynamics(q, v, bias + feet[0, 2])  # by 1 N upwards on the third foot
    assert foot_masses(M, feet)[0, 2] == pytest.approx(1.0 / (feet[0, 2] @ struck), rel=1e-9)


def test_frequencies_of_pendulums_on_springs():
    H = np.array([[[2.0, 0.0], [0.0, 0.5]]])
    np.testing.assert_allclose(natural_frequencies(H, np.array([8.0, 32.0])), [[2.0, 8.0]])


def test_levels_of_the_cheetah():
    """Only reaction on the carriers is lost: small in torques, twice as small in frequencies."""
    report = compare_levels(CHEETAH["armature"], poses=10)
    coupled, armature, none = report.rows
    assert coupled.torque == armature.torque
    assert report.joint_coupling.high == 0.0
    assert armature.frequency.median == pytest.approx(armature.torque.median / 2, rel=0.2)
    assert none.torque.low > 0.5 > armature.torque.high > 0.05
    assert verdict(report) == "No."


def test_in_words(capsys: pytest.CaptureFixture[str]):
    assert "has no rotors" in levels_report(Model("four_bar"), poses=3)
    assert main(["inspect", "mit_humanoid_leg", "--levels"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("\n") < 12
    assert "armature" in printed
