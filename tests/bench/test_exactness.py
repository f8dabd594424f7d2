"""The studies of exactness: closed forms, identities and the paper's points, on the smallest robot that shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ce_gym.bench.exactness import contacts, controllers
from ce_gym.bench.exactness.gait import Gait
from ce_gym.bench.exactness.legs import feedforward, loops, signals, stable_gain
from ce_gym.bench.exactness.mechanisms import leg_on_stand, limb, on_soles
from ce_gym.bench.exactness.protocol import FEET, HOLD, LEGS, STIFFNESSES
from ce_gym.bench.exactness.scaling import scaled
from ce_gym.bench.measure.report import Table
from ce_gym.dynamics import Model
from ce_gym.model import LinearConstraint, Robot, load_robot
from ce_gym.model.mechanism import LEVELS

pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
CHEETAH_LEG = LEGS["mini_cheetah_leg"]


def geared(robot: Robot, ratio: float) -> Robot:
    """Return a robot whose description has other gears."""
    rotors = {rotor.name for rotor in robot.rotors()}
    ties = tuple(
        replace(tie, coefficients=tuple((n, c if n in rotors else c * ratio) for n, c in tie.coefficients))
        if isinstance(tie, LinearConstraint) and set(tie.bodies) & rotors
        else tie
        for tie in robot.constraints
    )
    return replace(robot, constraints=ties)


@pytest.mark.parametrize("level", LEVELS)
def test_mass_matrix_of_other_gears_is_that_of_such_a_robot(level: str):
    robot = load_robot("mit_humanoid_leg")
    q = Model(robot).standing_q
    of_levels = {one: Model(robot, one).mass_matrix(q) for one in LEVELS}
    expected = Model(geared(robot, 1.7), level).mass_matrix(q)
    np.testing.assert_allclose(scaled(level, of_levels, 1.7, 1.0), expected, atol=1e-12)


def test_torque_of_other_rotors_is_the_derivative_of_the_model():
    model = Model("mit_humanoid_leg")
    rng = np.random.default_rng(0)
    state = model.standing_q, rng.normal(size=5), rng.normal(size=5)
    of_levels = {one: Model("mit_humanoid_leg", one).inverse_dynamics(*state) for one in LEVELS}
    slopes = model.derivatives("inverse_dynamics", wrt=["ratio", "rotor_inertia"]).jacobian(*state)
    step = 1e-6
    for name, change in (("ratio", (step, 0.0)), ("rotor_inertia", (0.0, step))):
        ahead, behind = (scaled("exact", of_levels, 1 + s * change[0], 1 + s * change[1]) for s in (1, -1))
        np.testing.assert_allclose(slopes["tau", name][:, 0], (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("name", ["tello_leg", "mini_cheetah_leg"])
def test_a_limb_is_its_block_of_the_robot(name: str):
    leg = LEGS[name]
    whole, part = Model(leg.robot), Model(limb(load_robot(leg.robot), leg.root or ""))
    columns = [6 + whole.joint_links.index(joint) for joint in part.joint_links]
    M = whole.mass_matrix(whole.standing_q)[np.ix_(columns, columns)]
    np.testing.assert_allclose(part.mass_matrix(part.standing_q), M, atol=1e-14)


def test_signals_are_derivatives_of_each_other():
    model = Model(leg_on_stand(CHEETAH_LEG))
    for motion in (signals.joint_chirp(model, 0), signals.swing(model, CHEETAH_LEG, 0)):
        slope = np.gradient(motion.x, HOLD, axis=0)[2:-2]
        bend = np.gradient(motion.xd, HOLD, axis=0)[2:-2]
        np.testing.assert_allclose(slope, motion.xd[2:-2], atol=1e-3 * np.abs(motion.xd).max())
        np.testing.assert_allclose(bend, motion.xdd[2:-2], atol=2e-3 * np.abs(motion.xdd).max())


def test_swinging_feet_run_at_their_speed():
    model = Model(leg_on_stand(CHEETAH_LEG))
    foot = signals.of_foot(model, signals.swing(model, CHEETAH_LEG, 0))
    lowest = foot.x[..., 2].argmin(0)
    speed = foot.xd[lowest, np.arange(foot.x.shape[1]), 0]
    np.testing.assert_allclose(speed, -CHEETAH_LEG.speed, rtol=0.02)


def test_a_perfect_model_is_stable_up_to_one_radian_a_sample():
    """A critically damped double integrator, sampled and held for T, is stable up to w T = 1."""
    model = Model(leg_on_stand(CHEETAH_LEG))
    for controller in controllers.CONTROLLERS:
        (hz,) = stable_gain.largest_bandwidth(CHEETAH_LEG, "exact", controller, model.standing_q[None])
        assert hz == pytest.approx(1 / (2 * np.pi * HOLD), rel=1e-5)


def test_the_linear_limit_is_the_simulation_s():
    """Below the largest stable gain an error dies out, above it it grows."""
    model = Model(leg_on_stand(CHEETAH_LEG))
    (hz,) = stable_gain.largest_bandwidth(CHEETAH_LEG, "armature", "joints", model.standing_q[None])
    motion = signals.Motion(*(np.tile(x, (400, 8, 1)) for x in (model.standing_q, *np.zeros((2, 3)))))
    pushed = motion.x[0] + 1e-4, np.zeros((8, 3))
    band = np.where(np.arange(400) < 50, 0, np.where(np.arange(400) < 350, -1, 1))
    task = loops.Task("joints", "chirp", motion, pushed, signals.held(pushed[0], 400), band, (1.0, 2.0))
    first, last = loops.follow(CHEETAH_LEG, task, ("armature",), (0.97 * hz, 1.03 * hz)).error[:, 0, :, 0]
    assert last[0] < 0.5 * first[0]
    assert last[1] > 2.0 * first[1]


def test_an_exact_controller_tracks_and_makes_no_error_of_torque():
    chirp = next(loops.chirps(CHEETAH_LEG, 0))
    exact, armature = np.moveaxis(
        loops.follow(CHEETAH_LEG, chirp, ("exact", "armature"), samples=200).torque_error, 1, 0
    )
    assert (exact[0] == 0).all()
    assert (armature[0] > 1e-3).all()


def test_a_posture_that_goes_along_asks_for_nothing_on_the_path():
    """A posture that stays behind is fought over by controllers of unlike models, the harder the stiffer it is held."""
    leg = LEGS["mit_humanoid_leg"]
    _, behind, along = loops.swings(leg, 0)
    foot = signals.foot_at(Model(leg_on_stand(leg)), along.posture.x)
    np.testing.assert_allclose(foot, along.motion.x, atol=2e-3)  # of a stride's harmonics, the first twelve
    shares = [
        result.torque_error[0, 0].mean(-1) / result.torque[0, 0].mean(-1)
        for result in (
            loops.follow(leg, replace(one, band=0 * one.band), ("armature",), (3.0, 20.0), samples=150)
            for one in (behind, along)
        )
    ]
    assert shares[0][1] > 1.5 * shares[0][0]
    assert shares[1][1] == pytest.approx(shares[1][0], rel=0.1)


def test_joints_that_take_a_foot_along():
    model = Model(leg_on_stand(LEGS["mit_humanoid_leg"]))
    chirp, rest = signals.foot_chirp(model, 0)
    part = signals.Motion(*(x[:200] for x in (chirp.x, chirp.xd, chirp.xdd)))
    again = signals.of_foot(model, signals.of_joints(model, part, rest))
    np.testing.assert_allclose(again.x, part.x, atol=1e-9)
    np.testing.assert_allclose(again.xd[2:-2], part.xd[2:-2], atol=1e-3 * np.abs(part.xd).max())


def test_the_paper_s_points_are_on_the_map():
    table = Table("", feedforward.COLUMNS, tuple(feedforward.as_published((1.5,))))
    assert [(r.measured, r.met) for r in controllers._published(table)] == [("4.3096", True), ("1.0446", True)]


def test_a_landing_gives_the_rigid_impulse_and_balances_momentum():
    faller = contacts.Faller("mini_cheetah", "exact")
    whole = faller.rigid_impulse().sum(-1)
    stiff = faller.land(STIFFNESSES[-1], contacts.LOSS_TIME * STIFFNESSES[-1])
    stopped = stiff.compressed  # feet that weigh next to nothing go on sinking under the motors' torques
    assert stopped[contacts.DESIGNS.index((1.0, 1.0))]
    np.testing.assert_allclose(stiff.impulse[stopped], whole[stopped], rtol=contacts.BAR)
    assert np.abs(stiff.imbalance).max() < contacts.BALANCE
    assert np.ptp(whole[stopped]) > 0.1 * whole.max()  # designs differ, so agreement is no accident


def test_free_motors_do_not_press_on():
    """Light feet come to a stop, and the impulse nears its rigid limit as the stiffness grows."""
    faller = contacts.Faller("tello", "none", control="torque")
    whole = faller.rigid_impulse().sum(-1)
    errors = []
    for stiffness in STIFFNESSES[-2:]:
        landing = faller.land(stiffness, contacts.LOSS_TIME * stiffness)
        assert landing.compressed.all()
        errors.append(np.abs(landing.impulse / whole - 1).max())
    assert errors[1] < 0.5 * errors[0] < 0.5 * contacts.BAR


def test_a_rigid_impulse_stops_the_feet():
    model = Model(on_soles("tello"), "armature")
    q, J = model.standing_q, contacts.feet_jacobian(model, model.standing_q)
    before = np.zeros(model.nv)
    before[5] = -1.0
    M = model.mass_matrix(q)
    impulse = np.linalg.solve(J @ np.linalg.solve(M, J.T), np.ones(len(FEET["tello"])))
    after = before + np.linalg.solve(M, J.T @ impulse)
    np.testing.assert_allclose(model.contact_points(q, after)[1][..., 2], 0.0, atol=1e-12)


def test_the_ground_carries_a_gait_by_virtual_work():
    """Joints turn, the base does not move: the ground's power on the feet is that of the torques it gives."""
    gait = Gait("mini_cheetah")
    model = Model(on_soles("mini_cheetah"))
    q, v, _ = gait._motion("mini_cheetah")
    v[:, :6] = 0.0
    rise = model.contact_points(q, v)[1][..., 2]
    late = np.array([phase for _, phase in gait.program.legs])
    force = np.maximum(np.cos(2 * np.pi * (gait.phase[:, None] - late)), 0) * np.pi * 9.81 * model.total_mass / 4
    np.testing.assert_allclose((gait.carried * v[:, 6:]).sum(-1), (force * rise).sum(-1), atol=1e-9)
    assert force.sum(-1).mean() == pytest.approx(9.81 * model.total_mass, rel=1e-3)


def test_cost_of_transport_by_hand():
    """Without rotors, a motor of half the ratio needs twice the torque: four times the loss, the same work."""
    gait = Gait("mini_cheetah")
    one, half = (float(gait.cost("none", np.array(r), np.array(1.0))) for r in (1.0, 0.5))
    tau = gait.torques["none"] - gait.carried
    motor = np.linalg.solve(np.swapaxes(gait.rates, 1, 2), tau[..., None])[..., 0]
    weight = 9.81 * Model("mini_cheetah").total_mass
    loss = (motor**2 / gait.k2).sum(-1).mean() / (weight * gait.program.speed)
    assert half - one == pytest.approx(3 * loss, rel=1e-9)
