"""Where scans are drawn is where the robot's sensors look; environments without one draw nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hopper import make_rollout
from tripod import TRIPOD

from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.setup import make_program
from ce_gym.viewer import Rollout, RolloutError, ViewerError
from ce_gym.viewer.page.robot import placed_scans
from ce_gym.viewer.rollouts.scan import scans_of

GRID = {"size": [0.8, 0.4], "spacing": 0.2, "centre": [0.1, 0.0]}


@pytest.mark.parametrize("seen", ["observations", "critic"])
def test_points_are_where_the_sensor_looks(seen: str) -> None:
    scan: Any = {"height_scan": {**GRID, "drift": 0.1, "dropout": 0.5}}
    program = make_program(TRIPOD, "velocity", terrain="rough", **{seen: scan})
    q = program.model.standing_q + 0.0
    q[:7] = [3.0, 4.0, 0.5, np.cos(0.4), 0.0, 0.0, np.sin(0.4)]
    (grid,), pose = program.stages.grids.values(), np.array(program.stages.places(begins=False)[0].function(q)).ravel()
    np.testing.assert_allclose(pose, [np.cos(0.8), np.sin(0.8), 3.0, 4.0], atol=1e-12)
    turn = np.array([[np.cos(0.8), np.sin(0.8)], [-np.sin(0.8), np.cos(0.8)]])
    (drawn,) = scans_of(program)
    assert (drawn["link"], drawn["at"]) == ("", [[0.0, 0.0, 0.0]])
    np.testing.assert_allclose(np.array(drawn["points"]) @ turn, np.array(grid) @ turn, atol=1e-12)


def leaning(program: TaskProgram, seed: int = 0) -> np.ndarray:
    rng, q = np.random.default_rng(seed), program.model.standing_q + 0.0
    q[:3], q[3:7] = [3.0, 4.0, 0.5], np.array([1.0, 0.2, -0.3, 0.4]) / np.sqrt(1.29)
    q[7:] += 0.3 * rng.standard_normal(len(q) - 7)
    return q


@pytest.mark.parametrize(("robot", "feet"), [(TRIPOD, 1), ("mini_cheetah", 4), ("mit_humanoid", 2)])
def test_grids_around_feet_are_where_the_sensor_looks(robot: Any, feet: int) -> None:
    seen: Any = {"height_scan": {**GRID, "around": "feet"}}
    program = make_program(robot, "velocity", terrain="rough", observations=seen)
    q, (grid,) = leaning(program), program.stages.grids.values()
    found = np.array(program.stages.places(begins=False)[0].function(q)).ravel()
    positions, rotations = (rows[0] for rows in program.model.body_poses(q[None]))
    scans = scans_of(program)
    assert len(scans) == feet
    for scan, centre in zip(scans, found[2:].reshape(-1, 2), strict=True):
        body = program.model.body_names.index(scan["link"])
        places = positions[body] + np.array(scan["at"]) @ rotations[body].T
        np.testing.assert_allclose(places.mean(0)[:2], centre, atol=1e-12)
        np.testing.assert_allclose(np.array(scan["points"]), np.array(grid), atol=1e-12)


@pytest.mark.parametrize("pattern", ["lidar", "camera"])
def test_rays_are_marched_where_the_sensor_marches(pattern: str) -> None:
    link = "forearm"
    rays = {"link": link, "position": [0.1, -0.05, 0.02], "rotation": [0.1, 0.4, -0.2], "rays": [2, 3]}
    march = {"reach": 1.5, "steps": 5, "pattern": pattern}
    program = make_program(TRIPOD, "velocity", terrain="rough", observations={"range_scan": rays | march})
    q, (scan,) = leaning(program), scans_of(program)
    found = np.array(program.stages.places(begins=False)[0].function(q)).ravel().reshape(-1, 2)
    positions, rotations = (rows[0] for rows in program.model.body_poses(q[None]))
    body = program.model.body_names.index(scan["link"])
    start = positions[body] + rotations[body] @ scan["at"][0]
    along = np.array(scan["rays"]) @ rotations[body].T
    marks = scan["reach"] / scan["steps"] * np.arange(1, scan["steps"] + 1)
    expected = (start + marks[:, None, None] * along)[..., :2].reshape(-1, 2)
    np.testing.assert_allclose(found, np.vstack([start[:2], expected]), atol=1e-12)


def test_without_a_scan_there_is_nothing_to_draw() -> None:
    assert scans_of(make_program(TRIPOD, "velocity", terrain="rough")) == ()
    program = make_program(TRIPOD, "velocity", terrain="rough", observations=["height_scan", "range_scan"])
    assert [len(scan[key]) for scan, key in zip(scans_of(program), ("points", "rays"), strict=True)] == [187, 21]


def test_a_rollout_keeps_its_scans(tmp_path: Path) -> None:
    points = ((0.5, -0.25), (1.0, 0.125))
    rays = {"link": "trunk", "at": [[0.1, 0.0, 0.0]], "rays": [[0.0, 0.6, -0.8]], "reach": 2.0, "steps": 4}
    about_the_base = {"link": "", "at": [[0.0, 0.0, 0.0]], "points": [list(point) for point in points]}
    saved = replace(make_rollout(), scan=(about_the_base, rays)).save(tmp_path / "scan.npz")
    assert Rollout.load(saved).scan == (about_the_base, rays)
    assert Rollout.load(make_rollout().save(tmp_path / "none.npz")).scan == ()


@pytest.mark.parametrize(
    ("scan", "said"),
    [
        ([(1.0, 2.0, 3.0)], "tuple; expected a mapping"),
        ([{"at": [[0, 0, 0]], "points": [[1, 2, 3]]}], r"points has shape \(1, 3\); expected rows of 2"),
        ([{"at": [[0, 0, 0]], "rays": [[0, 1]]}], r"rays has shape \(1, 2\); expected rows of 3"),
        ([{"at": [[0, 0, 0]], "rays": [[0, 0, 1]], "reach": 1}], "steps is None; expected a number"),
        ([{"points": [[0, 0]]}], r"at has shape \(0,\)"),
    ],
)
def test_what_is_no_scan_is_one_line(scan: Any, said: str) -> None:
    with pytest.raises(RolloutError, match=f"scan: {said}"):
        replace(make_rollout(), scan=scan)


def test_a_link_that_is_not_there_is_one_line() -> None:
    robot = make_program(TRIPOD, "velocity").model.robot
    with pytest.raises(ViewerError, match=r"scan: link='tail'; expected one of"):
        placed_scans([{"link": "tail"}], robot, "/world/0")
