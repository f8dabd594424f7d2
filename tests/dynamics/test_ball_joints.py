"""Ball joints in the tree: Pinocchio's equations, slopes in the tangent space, and refused uses of ball joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ball_joints import moved, random_state, rotation, with_balls
from pinocchio_peer import Peer

from ce_gym.dynamics import Model
from ce_gym.dynamics.standing import mass_matrix, standing_pose
from ce_gym.model import Joint, LinearConstraint, LoopConstraint, Pose, RobotError, check_robot, coincident_hinges

TURNED = (0.8, 0.0, -0.6, 0.0)


@pytest.mark.parametrize("floating", [True, False])
def test_dynamics_are_pinocchios(floating: bool):
    pytest.importorskip("pinocchio")
    robot = with_balls(floating)
    model, peer = Model(robot), Peer(robot)
    to_span = np.concatenate([np.eye(model.nv)[list(rows)] for rows in span_order(robot)])
    for seed in range(3):
        (q, v), tau = random_state(robot, seed), np.random.default_rng(seed).uniform(-1, 1, model.nv)
        q_span, v_span = model.spanning(q, v)
        np.testing.assert_array_equal(v_span, to_span @ v)
        M, bias = peer.dynamics(q_span, v_span)
        M, bias = to_span.T @ M @ to_span, to_span.T @ bias
        np.testing.assert_allclose(model.mass_matrix(q), M, atol=1e-12)
        np.testing.assert_allclose(model.bias_force(q, v), bias, atol=1e-12)
        expected = np.linalg.solve(M, tau - bias)
        np.testing.assert_allclose(model.forward_dynamics(q, v, tau), expected, atol=1e-12 * np.abs(expected).max())
        np.testing.assert_allclose(model.inverse_dynamics(q, v, expected), tau, atol=1e-11)


def span_order(robot):
    """Rows of `v` of every joint, in the order of bodies."""
    return [robot.rows[body.name][1] for body in robot.bodies]


def test_slopes_in_the_tangent_space():
    robot, h = with_balls(True), 1e-6
    model, (q, v) = Model(robot), random_state(robot, 1)
    tau = np.linspace(-1, 1, model.nv)
    slopes = model.forward_dynamics_derivatives(q, v, tau)[0]
    ends = [[model.forward_dynamics(moved(robot, q, s * h * e), v, tau) for s in (1, -1)] for e in np.eye(model.nv)]
    numeric = np.array([(a - b) / (2 * h) for a, b in ends]).T
    np.testing.assert_allclose(slopes, numeric, atol=1e-7 * np.abs(numeric).max())
    along = np.random.default_rng(2).normal(size=model.nv)
    derivatives = model.derivatives("energy", ("q",))
    product = derivatives.product(q, v, directions={"q": along})["potential"][0]
    gradient = derivatives.gradient(q, v, weights={"kinetic": [0.0], "potential": [1.0]})["q"]
    assert product == pytest.approx(gradient @ along, abs=1e-12)


def test_all_quantities_know_ball_joints():
    robot = replace(with_balls(True), pose=Pose(0.5, (("b", 0.2),), (("c", TURNED),)))
    check_robot(robot)
    model, (q, v) = Model(robot), random_state(robot, 3)
    assert (model.nq, model.nv) == (21, 17)
    np.testing.assert_allclose(model.standing_q[7:], [1, 0, 0, 0, *TURNED, 1, 0, 0, 0, 0.2, 0])
    np.testing.assert_allclose(
        mass_matrix(model.mechanism, standing_pose(model.mechanism)), model.mass_matrix(model.standing_q), atol=1e-12
    )
    back = model.from_spanning(*model.spanning(q, v))
    np.testing.assert_array_equal(np.concatenate(back), np.concatenate([q, v]))
    assert model.implicit_constraint(q, v)[0].shape == (0, 17)
    assert model.actuator_matrix(q, ["a", "b"]).shape == (4, 17)
    index = {name: i for i, name in enumerate(model.body_names)}
    poses, spins = model.body_poses(q)[1], model.body_velocities(q, v)[0]
    at, speeds = (slice(rows.start, rows.stop) for rows in robot.rows["c"])
    home = np.array(robot.body("c").placement.rotation)
    np.testing.assert_allclose(poses[index["c"]], poses[index["b"]] @ home @ rotation(q[at]), atol=1e-14)
    np.testing.assert_allclose(spins[index["c"]] - spins[index["b"]], poses[index["c"]] @ v[speeds], atol=1e-14)


def broken(**changes):
    robot = with_balls(True)
    return replace(robot, **changes)


def with_joint(name: str, joint: Joint):
    bodies = with_balls(True).bodies
    return broken(bodies=tuple(replace(b, joint=joint) if b.name == name else b for b in bodies))


@pytest.mark.parametrize(
    ("robot", "words"),
    [
        (broken(independent=("a", "b", "d")), "independent is 'a': expected the name of a body whose joint has one"),
        (broken(constraints=(LinearConstraint("t", (("a", 1.0), ("b", 1.0))),)), "'t' is 'a': expected a body whose"),
        (broken(constraints=(LoopConstraint("t", "ball", "e", None),)), "the free joint of base"),
        (
            broken(constraints=(LoopConstraint("t", "ball", "e", "d"),)),
            "the ball joint of c, which must be three revolute joints in a loop",
        ),
        (broken(pose=Pose(balls=(("b", TURNED),))), "pose.balls is 'b': expected the name of a body on a ball joint"),
        (broken(pose=Pose(balls=(("a", (1.0, 1.0, 0.0, 0.0)),))), "pose.balls.a is (1.0, 1.0, 0.0, 0.0): expected"),
        (with_joint("a", Joint("ball", position=(-1.0, 1.0))), "joint limits is (-1.0, 1.0): expected no lower one"),
        (with_joint("a", Joint("screw")), "expected one of free, ball, revolute, prismatic"),  # type: ignore[arg-type]
    ],
)
def test_wrong_uses_are_refused(robot, words: str):
    with pytest.raises(RobotError, match=r"^with_balls: [^\n]*$") as error:
        check_robot(robot)
    assert words in str(error.value)


def test_hinges_in_place_of_a_ball_joint_move_the_same():
    robot = with_balls(False)
    hinges = coincident_hinges(robot.body("a"), (1.0, 2.0, 2.0))
    rest = tuple(body for body in robot.bodies if body.name != "a")
    names = tuple(body.name for body in hinges)
    assert names == ("a_swing_1", "a_swing_2", "a")
    hinged = replace(robot, bodies=(*hinges, *rest), independent=(*robot.independent, *names))
    model, other = Model(robot), Model(hinged)
    (q, v), span = random_state(hinged, 5), other.spanning_names
    poses, spins = other.body_poses(q)[1], other.body_velocities(q, v)[0]
    R = np.array(robot.body("a").placement.rotation).T @ poses[span.index("a")]
    w = 0.5 * np.sqrt(1 + np.trace(R))
    turn = np.array([w, *(np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w))])
    same_q = np.concatenate([turn, q[: len(q) - 3]])
    same_v = np.concatenate([poses[span.index("a")].T @ spins[span.index("a")], v[: len(v) - 3]])
    np.testing.assert_allclose(np.stack(model.energy(same_q, same_v)), np.stack(other.energy(q, v)), rtol=1e-12)
