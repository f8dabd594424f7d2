"""Comparisons with measurements: data, errors, and fits of simulated data whose parameters are known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("scipy")

from ce_gym.bench.measured import cube, data, go2_log
from ce_gym.bench.measured.cube_engines import Ours, Peer, into_body
from ce_gym.bench.measured.tosses import SIDE, Tosses, corner_error, depths, errors, final, read_tosses
from ce_gym.identify.base_fixed import fix_base
from ce_gym.identify.parameters import select_parameters
from ce_gym.model import RobotError

FREE = {"friction": 0.2, "ground": -1.0, "stiffness": 1e4, "damping": 50.0, "timeconst": 0.02, "dampratio": 1.0}


def candidates(**changes: float) -> dict[str, np.ndarray]:
    return {name: np.array([value]) for name, value in (FREE | changes).items()}


@pytest.fixture(scope="module")
def tosses() -> Tosses:
    return read_tosses()


def test_a_changed_file_of_measurements_is_refused(tmp_path: Path):
    content = (data.FOLDER / "go2_joint_log.npz").read_bytes()
    (tmp_path / "go2_joint_log.npz").write_bytes(content[:-1] + b"!")
    with pytest.raises(RobotError, match="SHA-256"):
        data.load("go2_joint_log.npz", tmp_path)
    with pytest.raises(RobotError, match="is missing"):
        data.load("cube_tosses.npz", tmp_path)


def test_the_files_hold_what_their_publishers_describe(tosses: Tosses):
    assert tosses.poses.shape == (400, 130, 7)
    assert tosses.dt == pytest.approx(1 / 148)
    resting = depths(tosses.poses)[np.arange(400), tosses.lengths - 1]
    assert 0.001 < np.median(resting) < 0.003  # the table is lower than z = 0
    log = go2_log.read_go2_log()
    assert log.values.shape == log.commands.shape == (3288, 12)
    assert log.dt == pytest.approx(0.005, rel=1e-3)


def test_errors_of_a_shifted_and_turned_cube(tosses: Tosses):
    still = tosses.select(np.array([0, 1]))
    turn = np.array([np.cos(0.1), 0.0, 0.0, np.sin(0.1)])  # 0.2 rad about the z axis of the cube
    w, v = still.poses[..., 3:4], still.poses[..., 4:]
    z = np.array([0.0, 0.0, 1.0])
    quaternions = np.concatenate(
        [w * turn[0] - v[..., 2:] * turn[3], turn[0] * v + turn[3] * (w * z + np.cross(v, z))], -1
    )
    moved = np.concatenate([still.poses[..., :3] + np.array([0.003, 0.0, 0.004]), quaternions], axis=-1)
    position, rotation = errors(still, moved)
    np.testing.assert_allclose(final(still, position), 0.005)
    np.testing.assert_allclose(final(still, rotation), 0.2)
    assert np.isnan(position[0, still.lengths[0] :]).all()
    corners = SIDE / 2 * np.array([[x, y, zz] for x in (-1, 1) for y in (-1, 1) for zz in (-1, 1)])
    turned = np.stack([np.cos(0.2) * corners[:, 0] - np.sin(0.2) * corners[:, 1],
                       np.sin(0.2) * corners[:, 0] + np.cos(0.2) * corners[:, 1], corners[:, 2]], axis=1)  # fmt: skip
    expected = np.sqrt(np.square(turned - corners).sum(1).mean())
    assert corner_error(np.array(0.0), np.array(0.2)) == pytest.approx(expected)


def test_both_engines_fly_as_the_measured_cube_does(tosses: Tosses):
    """No contact: the table is a metre lower."""
    few = tosses.select(np.arange(0, 400, 20))
    ours, theirs = (engine(few, candidates())[0] for engine in (Ours(0.0), Peer(None)))
    np.testing.assert_allclose(ours[:, :20], theirs[:, :20], atol=2e-3)
    position, _ = errors(few, ours)
    assert np.median(position[:, 10]) < 0.002


@pytest.mark.parametrize("engine", [Ours(0.008), Peer(0.008), Peer(None)])
def test_a_cube_comes_to_rest_on_the_table(tosses: Tosses, engine: Ours | Peer):
    few = tosses.select(np.arange(10))
    poses = engine(few, candidates(ground=-0.002))[0]
    assert np.abs(poses[:, -1] - poses[:, -10]).max() < 2e-3
    assert np.median(depths(poses[:, -1])) == pytest.approx(0.002, abs=1e-3)


def test_the_fit_recovers_the_friction_of_simulated_tosses(tosses: Tosses):
    few, engine = tosses.select(np.arange(40)), Ours(0.0)
    true = candidates(friction=0.23, ground=-0.001)
    simulated = dataclasses.replace(few, poses=engine(few, true)[0])
    best, error = cube.fit(engine, simulated)
    assert best["friction"][0] == pytest.approx(0.23, rel=0.05)
    measured = cube.fit(engine, few)[1]
    assert error < 0.6 * measured


def test_vectors_are_rotated_into_the_axes_of_a_body():
    quarter = np.array([[np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]])  # a quarter turn about z
    np.testing.assert_allclose(into_body(quarter, np.array([[1.0, 0.0, 0.0]])), [[0.0, -1.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(("dry", "difference"), [(0.0, 2e-4), (0.03, 1e-3)])
def test_mujoco_replays_the_log_as_ce_gym_at_armature_does(
    dry: float, difference: float, monkeypatch: pytest.MonkeyPatch
):
    """Robot, gains and friction are the same, and steps are short; MuJoCo's dry friction is softer."""
    monkeypatch.setattr(go2_log, "SUBSTEP", 0.0005)
    robot, log = go2_log.go2(), go2_log.read_go2_log()
    planted = {"rotor_inertia": 3.0, "motor_damping": 0.002, "motor_friction": dry, "delay": 0.002}
    parameters = select_parameters(fix_base(robot, log.commanded), tuple(planted))
    values = np.array([planted[parameter.kind] for parameter in parameters])
    ours, theirs = (go2_log.replay(robot, log, name, parameters, values) for name in ("ce_gym, armature", "MuJoCo"))
    assert go2_log.rms(ours - theirs) < difference
    assert go2_log.rms(ours) > 5 * difference
