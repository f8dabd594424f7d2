"""Rotors eliminated exactly against the general cluster algorithm, and what the levels keep."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import Robot, RobotError
from ce_gym.model.mechanism import LEVELS


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


def test_elimination_is_exact(robot: Robot, random_state):
    special, general = both(robot)
    assert not any(body.name.endswith("rotor") for body in special.mechanism.bodies.values())
    assert_same_dynamics(special, general, random_state, 1e-11)


def test_elimination_is_exact_for_rotors_on_any_carrier(awkward_robot, random_state):
    special, general = both(awkward_robot())
    assert len(special.mechanism.bodies) == 4
    assert_same_dynamics(special, general, random_state, 1e-11)


def test_lopsided_rotors_stay_bodies(awkward_robot):
    special, _ = both(awkward_robot(lopsided=1e-4))
    assert len(special.mechanism.bodies) == 7


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
    with pytest.raises(RobotError, match=r"transmission 'rigid' does not exist; expected one of exact, coupled"):
        Model(robot, "rigid")


def test_exactness_costs_next_to_nothing():
    """Instruction counts are deterministic; the figure is the paper's cost measure."""
    exact, armature = Model("mini_cheetah"), Model("mini_cheetah", "armature")
    ratio = exact.n_instructions("forward_dynamics") / armature.n_instructions("forward_dynamics")
    assert ratio <= 1.03
