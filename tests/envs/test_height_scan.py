"""Height scans against brute force on `Terrain.at`, with and without errors of the sensor; flat ground needs none."""

from __future__ import annotations

import casadi as ca
import gymnasium
import numpy as np
import pytest
from tripod import TRIPOD

import ce_gym
from ce_gym.compile import Lookup
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.task.terrain_tiles import make_field

ERRORS = {"drift": 0.04, "shift": 0.05, "dropout": 0.2, "delay": 2}
GRID = {"size": (0.8, 0.4), "spacing": 0.2, "centre": (0.1, 0.0)}
N = 24


@pytest.fixture(scope="module")
def envs():
    """Steep ground, for readings to be cut off too; episodes of 12 steps; the critic's readings have no errors."""
    return gymnasium.make_vec(
        "ce_gym/MiniCheetahVelocity-v0",
        robot=TRIPOD,
        num_envs=N,
        autoreset_mode="SameStep",
        max_episode_steps=12,
        terrain={"kind": "rough", "amplitude": 0.4, "curriculum": False},
        observations={"height_scan": {**GRID, **ERRORS, "clip": 0.2, "scale": 5.0}},
        critic=["base_height"],
        obs_mode="dict",
    ).unwrapped


def points(q: np.ndarray, size=(0.8, 0.4), spacing=0.2, centre=(0.1, 0.0)) -> np.ndarray:
    """Grids about bases, from behind to ahead and from right to left, by quaternions; shape (n, points, 2)."""
    x = centre[0] + np.arange(-size[0] / 2, size[0] / 2 + 1e-9, spacing)
    y = centre[1] + np.arange(-size[1] / 2, size[1] / 2 + 1e-9, spacing)
    w, i, j, k = q[:, 3:7].T
    yaw = np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))[:, None]
    gx, gy = (along.ravel() for along in np.meshgrid(x, y, indexing="ij"))
    turned = np.stack([np.cos(yaw) * gx - np.sin(yaw) * gy, np.sin(yaw) * gx + np.cos(yaw) * gy], axis=-1)
    return q[:, None, :2] + turned


def looked_at(pose: np.ndarray, grid) -> tuple[np.ndarray, np.ndarray]:
    """Points of a grid as a `Lookup` turns it, shape (m, 2), and places where it puts it, shape (n, 2)."""
    (c, s), places = pose[:2], pose[2:].reshape(-1, 2)
    return np.array(grid) @ [[c, s], [-s, c]], places


def test_readings_are_those_of_brute_force(envs):
    """The critic's exact; the policy's late, shifted, drifted and with gaps; through resets."""
    program = envs.batch.program
    ground, standing = make_field(program.task.terrain), program.model.robot.pose.height

    def reading(q, shift=0.0, drift=0.0):
        above = q[:, 2:3] - standing - ground.at(*np.moveaxis(points(q) + shift, -1, 0))[..., 0]
        return 5 * np.clip(above + drift, -0.2, 0.2)

    observation, _ = envs.reset(seed=0)
    poses, drifts, lost, cut = [envs.state()["q"]] * 3, [], 0, 0
    for _ in range(30):
        drift = ERRORS["drift"] * envs.batch.rows("observation_height_scan_offset")
        shift = ERRORS["shift"] * envs.batch.rows("observation_height_scan_shift")[:, None]
        expected = reading(poses[-3], shift, drift)
        found, exact = observation["policy"], observation["critic"][:, :15]
        np.testing.assert_allclose(exact, reading(poses[-1]), atol=1e-6)
        gaps = (found == 0) & (np.abs(expected) > 1e-6)
        np.testing.assert_allclose(found[~gaps], expected[~gaps], atol=1e-6)
        lost, cut = lost + gaps.mean() / 30, cut + (np.abs(found) == 1).mean() / 30
        drifts.append(np.hstack([drift, shift[:, 0]]))
        observation, _, terminated, truncated, _ = envs.step(envs.action_space.sample() * 0.1)
        q = envs.state()["q"]
        begun = (terminated | truncated)[:, None]
        poses = [np.where(begun, q, pose) for pose in poses[1:]] + [q]
    assert lost == pytest.approx(0.2, abs=0.02)
    assert 0.02 < cut < 0.98
    assert len(np.unique(np.round(drifts, 12).reshape(-1, 3), axis=0)) > 2 * N, "drawn for every episode"
    assert (np.abs(drifts).max(axis=(0, 1)) <= [0.04, 0.05, 0.05]).all()
    assert np.std(drifts, axis=(0, 1)) == pytest.approx(np.array([0.04, 0.05, 0.05]) / np.sqrt(3), rel=0.2)


def test_around_feet_it_is_about_their_lowest_points():
    """Where it looks, and how far up the feet are, by the model's own contact points."""
    scan = {"size": (0.2, 0.0), "around": "feet", "clip": 9.0}
    program = make_program("mini_cheetah", "velocity", terrain="rough", observations={"height_scan": scan})
    (key,), robot = program.stages.grids, program.model.robot
    (call,) = program.stages.places(begins=False)
    q = program.model.standing_q + 0.0
    q[:7] = [3.0, 4.0, 0.5, np.cos(0.4), 0.0, 0.0, np.sin(0.4)]
    turned, places = looked_at(np.array(call.function(q)).ravel(), program.stages.grids[key])
    at = places[:, None] + turned
    spheres = [i for i, sphere in enumerate(robot.contacts) if sphere.group == "foot"]
    feet = program.model.contact_points(q, np.zeros(program.model.nv))[0][spheres]
    ahead = 0.1 * np.array([np.cos(0.8), np.sin(0.8)])
    expected = feet[:, None, :2] + np.array([-1.0, 0.0, 1.0])[:, None] * ahead
    np.testing.assert_allclose(at, expected, atol=1e-12)
    s = program.stages.context(program.stages.state)
    lowest = ca.Function("lowest", [s.q], [ca.horzcat(*s.foot_places)[2, :]])(q)
    radius = np.array([robot.contacts[i].radius for i in spheres])
    np.testing.assert_allclose(np.array(lowest)[0], feet[:, 2] - radius, atol=1e-12)
    assert program.stages.ground_values[key].numel() == 12


def test_flat_ground_is_not_looked_up():
    program = make_program(TRIPOD, "velocity", observations={"height_scan": {}})
    assert not any(isinstance(call, Lookup) for call in program.step_program().calls)
    plain = make_program(TRIPOD, "velocity", observations=["base_height"])
    more = program.function("evaluate").n_instructions() - plain.function("evaluate").n_instructions()
    assert more < 3 * 187, "one height, shown 187 times"


def test_a_term_may_look_only_where_it_is_known_to_look(monkeypatch: pytest.MonkeyPatch):
    from ce_gym.envs.terms import registry

    monkeypatch.setattr(registry, "_added", {kind: {} for kind in registry.OWN})

    @ce_gym.observation
    def peeping(s):
        return s.ground_under("there", s.torque[:2])

    program = make_program(TRIPOD, "velocity", terrain="rough", observations=["peeping"])
    assert program.stages.ground_values["observation_peeping_there"].numel() == 1

    @ce_gym.observation
    def chasing(s):
        return s.ground_under("there", ca.vertcat(s.chance(1), s.q[1]))

    program = make_program(TRIPOD, "velocity", terrain="rough", observations=["chasing"])
    with pytest.raises(ValueError, match=r"observation_chasing_there_places: depends on u.*; expected positions"):
        program.step_program()


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"size": 1.0}, "size=1.0; expected two lengths"),
        ({"size": [1.0, "2"]}, r"size=\[1.0, '2'\]; expected two lengths"),
        ({"size": [50.0, 50.0]}, r"size=\[50.0, 50.0\]; expected at most 2000 points"),
        ({"spacing": 0.0}, "spacing=0.0; expected a length above 0 m"),
        ({"around": "head"}, "around='head'; expected 'base' or 'feet'"),
        ({"dropout": 1.0}, "dropout=1.0; expected a share"),
        ({"delay": 0.5}, "delay=0.5; expected a whole number"),
        ({"drift": -0.1}, "drift=-0.1; expected a length"),
    ],
)
def test_bad_parameters(parameters: dict, message: str):
    with pytest.raises(ValueError, match=f"observation term 'height_scan': {message}") as caught:
        make_program(TRIPOD, "velocity", observations={"height_scan": parameters})
    assert "\n" not in str(caught.value)
