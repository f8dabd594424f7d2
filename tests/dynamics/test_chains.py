"""The paper's scaling chains stand as they should; test_vectors.py compares them with the authors' library."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.bench import chains
from ce_gym.dynamics import Model
from ce_gym.model import Robot


@pytest.mark.parametrize(
    "robot", [chains.four_bar_chain(1, 2), *map(chains.rod_parallel_chain, (3, 3), (3, 7))], ids=lambda r: r.name
)
def test_standing_pose_closes_the_loops(robot: Robot):
    model = Model(robot)
    positions, rotations = model.body_poses(model.standing_q)
    for loop in robot.constraints:
        first, second = (model.body_names.index(body) for body in (loop.first, loop.second))
        ends = [
            positions[body] + rotations[body] @ np.array(placement.position)
            for body, placement in ((first, loop.first_placement), (second, loop.second_placement))
        ]
        np.testing.assert_allclose(*ends, atol=1e-12)
    assert np.linalg.cond(model.mass_matrix(model.standing_q)) < 1e6
