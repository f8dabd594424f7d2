"""Signals for plots, and torques as shares of their limits."""

from __future__ import annotations

import base64

import numpy as np
import pytest
from hopper import StandIn, make_robot, make_rollout

from ce_gym.dynamics import Model
from ce_gym.viewer import Rollout, ViewerError
from ce_gym.viewer.page.charts import charts, default_plots
from ce_gym.viewer.page.scene import pose_rollouts

FRAMES = 40


@pytest.fixture(scope="module")
def rollout() -> Rollout:
    model, rng = Model("mini_cheetah"), np.random.default_rng(0)
    return Rollout(
        "mini_cheetah",
        "exact",
        0.01,
        0.01 * np.arange(FRAMES),
        np.tile(model.standing_q, (FRAMES, 1)),
        rng.standard_normal((FRAMES, model.nv)),
        rng.standard_normal((FRAMES, len(model.contact_names), 3)),
        rng.standard_normal((FRAMES, 3)),
        10 * rng.standard_normal((FRAMES, 12)),
        rng.standard_normal((FRAMES, 2)),
        ("reward", "reward: torques"),
    )


@pytest.fixture(scope="module")
def found(rollout: Rollout):
    return charts(pose_rollouts([rollout], [Model("mini_cheetah")], max_fps=50)[0])


def test_signals_are_those_of_the_frames_shown(rollout: Rollout, found) -> None:
    frames = np.arange(0, FRAMES, 2)
    joints = Model("mini_cheetah").robot.independent
    name = joints[1].removesuffix("_link")
    for signal, values in {
        "forward speed [m/s]": rollout.v[:, 3],
        "sideways speed [m/s]": rollout.v[:, 4],
        "turning [rad/s]": rollout.v[:, 2],
        "height of the base [m]": rollout.q[:, 2],
        "force from the ground [N]": rollout.contact_forces[..., 2].sum(1),
        "reward: torques": rollout.signals[:, 1],
        f"torque of {name} [N m]": rollout.torques[:, 1],
        f"speed of {name} [rad/s]": rollout.v[:, 7],
    }.items():
        np.testing.assert_allclose(found.signals[signal], values[frames], err_msg=signal)
    np.testing.assert_array_equal(found.commanded["turning [rad/s]"], rollout.commands[frames, 2])
    assert len(found.signals) == 3 + 1 + 1 + 2 + 12 + 12


def test_effort_is_torque_over_limit(rollout: Rollout, found) -> None:
    robot = Model("mini_cheetah").robot
    for index, joint in enumerate(robot.independent):
        limit = robot.body(joint).joint.torque
        np.testing.assert_allclose(found.effort[:, index], np.abs(rollout.torques[::2, index]) / limit)
        assert found.paths[index].endswith(f"/{joint}")
        assert found.limits[f"torque of {joint.removesuffix('_link')} [N m]"] == limit
    packed = np.frombuffer(base64.b64decode(found.as_json()["effort"]), np.uint8).reshape(found.effort.shape)
    np.testing.assert_allclose(packed / 255, np.minimum(found.effort, 1), atol=0.5 / 255)


def test_without_torques_there_is_no_effort() -> None:
    found = charts(pose_rollouts([make_rollout()], [StandIn(make_robot())])[0])
    assert found.as_json()["effort"] == ""
    assert found.as_json()["paths"] == []


def test_chosen_by_name_and_by_default(rollout: Rollout, found) -> None:
    hardest = Model("mini_cheetah").robot.independent[int(found.effort.max(0).argmax())].removesuffix("_link")
    assert default_plots([found], []) == ["forward speed [m/s]", f"torque of {hardest} [N m]", "reward"]
    assert default_plots([found], ["reward", "turn", "FL_knee"])[:2] == ["reward", "turning [rad/s]"]
    assert "FL_knee" in default_plots([found], ["FL_knee"])[0]
    with pytest.raises(ViewerError, match=r"no signal 'smell' to plot; expected one of forward speed \[m/s\], "):
        default_plots([found], ["smell"])


def test_torques_that_do_not_fit_are_refused(rollout: Rollout) -> None:
    from dataclasses import replace

    run = pose_rollouts([replace(rollout, torques=rollout.torques[:, :5])], [Model("mini_cheetah")])[0]
    with pytest.raises(ViewerError, match="torques of 5 joints; the robot has 12"):
        charts(run)
