"""Who crosses a stretch of ground: steering, and that only those count who get there on their feet."""

import numpy as np
import pytest

from ce_gym.learn.evaluation.crossing import cross, steering_command
from ce_gym.learn.evaluation.tables import crossing_table
from ce_gym.policies import Policy, PolicyError


def pose(x, heading):
    q = np.zeros((1, 7))
    q[0, 0], q[0, 3], q[0, 6] = x, np.cos(heading / 2), np.sin(heading / 2)
    return q


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_point_that_follows_its_commands_comes_to_its_line(side):
    x, y, heading, dt = 0.4, 0.0, -side * 1.0, 0.02
    for _ in range(1000):
        forward, sideways, turn = steering_command(pose(x, heading), np.zeros(1), np.array([side]), 0.5)[0]
        assert (forward, sideways) == (0.5, 0.0)
        assert abs(turn) <= 1
        heading += dt * turn
        x, y = x + dt * forward * np.cos(heading), y + dt * forward * np.sin(heading)
    assert abs(x) < 1e-3
    assert side * y > 8


STAND = Policy(
    lambda observation: np.zeros((len(observation), 12), "f4"),
    {
        "env": "ce_gym/MiniCheetahVelocity-v0",
        "policy_spec": {"command": {"range": [[0, 1], [0, 0], [0, 0]]}, "control_dt": 0.02},
        "observation_size": 48,
    },
)


def test_who_stands_neither_crosses_nor_falls():
    result = cross(STAND, 8, 0, distance=2.0, speed=1.0)
    assert (result["crossed"], result["fell"], result["episodes"]) == (0.0, 0.0, 8)
    assert "levels" not in result
    assert cross(STAND, 8, 0, distance=-1.0, speed=-1.0)["crossed"] == 1.0  # who has nowhere to go is there
    assert "| all   | 0.0%    | 0.0% | 8        |" in crossing_table(result)


def test_a_task_without_commands_is_refused():
    with pytest.raises(PolicyError, match="no commanded velocities"):
        cross(Policy(lambda x: x, {"env": "ce_gym/MiniCheetahRun-v0", "policy_spec": {}}), 1, 0)
