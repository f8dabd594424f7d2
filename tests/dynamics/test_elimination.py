"""Rotors eliminated exactly against the general cluster algorithm, and the approximations of each level."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linkages import rod_leg

from ce_gym.dynamics import Model
from ce_gym.model import Placement, Robot, RobotError
from ce_gym.model.mechanism import LEVELS

LOPSIDED = 1e-3
"""Makes the transverse moments of a rotor differ by more than half of its axial moment."""


def both(robot: Robot) -> tuple[Model, Model]:
    return Model(robot), Model(robot, eliminate_rotors=False)


def assert_same_dynamics(special: Model, general: Model, random_state, tolerance: float) -> None:
    q, v = random_state(special, 50)
    tau = np.random.default_rng(1).normal(0, 10, v.shape)
    ours, theirs = special.forward_dynamics(q, v, tau), general.forward_dynamics(q, v, tau)
    assert np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max()
    ours, theirs = special.inverse_dynamics(q, v, tau), general.inverse_dynamics(q, v, tau)
    assert np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max()
    np.testing.assert_allclose(special.mass_matrix(q), general.mass_matrix(q), atol=tolerance * 10)
    wrenches = {name: np.random.default_rng(2).normal(0, 10, 6) for name in special.body_names}
    ours, theirs = special.forward_dynamics(q, v, tau, wrenches), general.forward_dynamics(q, v, tau, wrenches)
    assert np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max()
    (kinetic, potential), (expected_kinetic, expected_potential) = special.energy(q, v), general.energy(q, v)
    np.testing.assert_allclose(kinetic, expected_kinetic, rtol=tolerance)
    shift = potential - expected_potential  # constant: the potential energy of eliminated rotors on the world
    np.testing.assert_allclose(shift, shift[0], atol=tolerance * np.abs(potential).max())


def test_elimination_is_exact(robot: Robot, random_state):
    special, general = both(robot)
    assert not any(body.name.endswith("rotor") for body in special.mechanism.bodies.values())
    assert_same_dynamics(special, general, random_state, 1e-11)


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("lopsided", [0.0, LOPSIDED])
def test_elimination_is_exact_for_rotors_on_any_carrier(awkward_robot, random_state, lopsided, floating):
    special, general = both(awkward_robot(lopsided, floating=floating))
    assert set(special.mechanism.bodies) == {*(["base"] if floating else []), "thigh", "shank", "toe"}
    assert_same_dynamics(special, general, random_state, 1e-12)


def test_elimination_is_exact_where_a_closed_loop_turns_a_lopsided_rotor(random_state):
    robot = rod_leg()
    motor = robot.body("motor")
    across = Placement(motor.placement.position, ((0.0, 0.6, 0.8), (1.0, 0.0, 0.0), (0.0, 0.8, -0.6)))
    inertia = ((2e-3, 3e-4, 0.0), (3e-4, 1e-3, 0.0), (0.0, 0.0, 2e-3))
    lopsided = replace(motor, placement=across, inertial=replace(motor.inertial, inertia=inertia))
    special, general = both(replace(robot, bodies=(*robot.bodies[:-1], lopsided)))
    assert len(special.mechanism.bodies) == len(general.mechanism.bodies) - 1
    q, v = random_state(special, 20)
    q[:, 7:] = special.standing_q[7:] + 0.1 * q[:, 7:]
    assert_same_dynamics(special, general, lambda *_: (q, v), 1e-12)


def test_rotors_about_no_principal_axis_stay_bodies(awkward_robot):
    special, _ = both(awkward_robot(tilted=1e-4))
    assert len(special.mechanism.bodies) == 7


def test_other_levels_keep_a_lopsided_rotor_as_it_lies_at_angle_zero(awkward_robot):
    """Seen by the base in the pose where all rotors are at zero, and only there."""
    robot = awkward_robot(LOPSIDED)
    models = [Model(robot, level) for level in LEVELS]
    joints = np.linalg.solve([[6.0, 3.0, 0.0], [2.0, 9.0, -4.0], [-3.0, 0.0, -7.0]], [-0.1, 0.0, 0.0])
    q = np.array([0, 0, 0, 1, 0, 0, 0, *joints])
    np.testing.assert_allclose(models[0].spanning(q, np.zeros(9))[0][-3:], 0.0, atol=1e-15)
    exact, *others = (model.mass_matrix(q)[:6, :6] for model in models)
    for base in others:
        np.testing.assert_allclose(base, exact, atol=1e-14)
    q[7:] += 0.1
    exact, *others = (model.mass_matrix(q)[:6, :6] for model in models)
    for base in others:
        assert np.abs(base - exact).max() > 0.1 * LOPSIDED


def test_forward_undoes_inverse_at_every_level(robot: Robot, random_state):
    for level in LEVELS:
        model = Model(robot, level)
        q, v = random_state(model, 20)
        vdot = np.random.default_rng(2).normal(0, 10, v.shape)
        back = model.forward_dynamics(q, v, model.inverse_dynamics(q, v, vdot))
        np.testing.assert_allclose(back, vdot, rtol=1e-9, atol=1e-9)


def test_levels_differ_by_reflected_inertia_only(robot: Robot, random_state):
    models = {level: Model(robot, level) for level in LEVELS}
    q, _ = random_state(models["none"], 5)
    M = {level: model.mass_matrix(q) for level, model in models.items()}
    joints = slice(6 if robot.floating else 0, None)
    ratio = {name: i for i, name in enumerate(robot.independent)}
    expected = np.zeros((len(robot.independent),) * 2)
    for constraint in robot.constraints:
        (rotor,) = [name for name in constraint.bodies if robot.body(name).kind == "rotor"]
        scale = dict(constraint.coefficients)[rotor]
        row = np.zeros(len(robot.independent))
        for name, coefficient in constraint.coefficients:
            if name != rotor:
                row[ratio[name]] = -coefficient / scale
        axis = np.array(robot.body(rotor).joint.axis)
        expected += axis @ np.array(robot.body(rotor).inertial.inertia) @ axis * np.outer(row, row)
    for level, block in (("coupled", expected), ("armature", np.diag(np.diag(expected)))):
        difference = M[level] - M["none"]
        np.testing.assert_allclose(
            difference[:, joints, joints], np.broadcast_to(block, difference[:, joints, joints].shape), atol=1e-12
        )
        difference[:, joints, joints] = 0.0
        np.testing.assert_allclose(difference, 0.0, atol=1e-12)


def test_total_mass_is_the_same_at_every_level(robot: Robot):
    masses = [Model(robot, level).total_mass for level in LEVELS]
    assert masses == pytest.approx([robot.total_mass] * len(LEVELS))
    if robot.floating:  # seen by the dynamics, not only by the book-keeping
        M = [Model(robot, level).mass_matrix(Model(robot).standing_q) for level in LEVELS]
        for m in M:
            assert m[3, 3] == pytest.approx(robot.total_mass)


def test_deleted_rotors_are_gone(robot: Robot):
    model = Model(robot, "none", locked_rotors=False)
    assert model.total_mass == pytest.approx(sum(b.inertial.mass for b in robot.bodies if b.kind == "link"))


def test_unknown_level_is_refused(robot: Robot):
    with pytest.raises(
        RobotError, match=r"transmission 'rigid' does not exist; expected one of elastic, exact, coupled"
    ):
        Model(robot, "rigid")


def test_exactness_costs_next_to_nothing():
    """Instruction counts are deterministic; the figure is the paper's cost measure."""
    exact, armature = Model("mini_cheetah"), Model("mini_cheetah", "armature")
    ratio = exact.n_instructions("forward_dynamics") / armature.n_instructions("forward_dynamics")
    assert ratio <= 1.03
