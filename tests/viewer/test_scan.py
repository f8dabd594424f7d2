"""Where a height scan is drawn is where the robot's sensor looks; environments without one draw nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hopper import make_rollout
from tripod import TRIPOD

from ce_gym.envs.runtime.setup import make_program
from ce_gym.viewer import Rollout, RolloutError
from ce_gym.viewer.rollouts.scan import scan_points

GRID = {"size": [0.8, 0.4], "spacing": 0.2, "centre": [0.1, 0.0]}


@pytest.mark.parametrize("seen", ["observations", "critic"])
def test_points_are_where_the_sensor_looks(seen: str) -> None:
    scan: Any = {"height_scan": {**GRID, "drift": 0.1, "dropout": 0.5}}
    program = make_program(TRIPOD, "velocity", terrain="rough", **{seen: scan})
    q = program.model.standing_q + 0.0
    q[:7] = [3.0, 4.0, 0.5, np.cos(0.4), 0.0, 0.0, np.sin(0.4)]
    (grid,), pose = program.probe.grids.values(), np.array(program.stages.places(begins=False)[0].function(q)).ravel()
    np.testing.assert_allclose(pose, [np.cos(0.8), np.sin(0.8), 3.0, 4.0], atol=1e-12)
    turn = np.array([[np.cos(0.8), np.sin(0.8)], [-np.sin(0.8), np.cos(0.8)]])
    np.testing.assert_allclose(np.array(scan_points(program)) @ turn, np.array(grid) @ turn, atol=1e-12)


def test_without_a_scan_about_the_base_there_are_no_points() -> None:
    assert scan_points(make_program(TRIPOD, "velocity", terrain="rough")) == ()
    feet = {"height_scan": {"around": "feet"}}
    assert scan_points(make_program(TRIPOD, "velocity", terrain="rough", observations=feet)) == ()
    program = make_program(TRIPOD, "velocity", terrain="rough", observations=["height_scan"])
    assert len(scan_points(program)) == 187


def test_a_rollout_keeps_its_points(tmp_path: Path) -> None:
    points = ((0.5, -0.25), (1.0, 0.125))
    saved = replace(make_rollout(), scan=points).save(tmp_path / "scan.npz")
    assert Rollout.load(saved).scan == points
    assert Rollout.load(make_rollout().save(tmp_path / "none.npz")).scan == ()
    with pytest.raises(RolloutError, match="scan has shape"):
        replace(make_rollout(), scan=[(1.0, 2.0, 3.0)])
