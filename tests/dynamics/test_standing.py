"""The mass matrix that a model is checked by, worked out in numbers, is the one that it traces."""

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.dynamics.standing import mass_matrix, standing_pose
from ce_gym.model.mechanism import LEVELS


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", ["jvrc1", "mit_humanoid_leg", "planar_leg_linkage", "tello"])
def test_mass_matrix_in_numbers(name, level):
    model = Model(name, level)
    traced = model.mass_matrix(model.standing_q)
    numbers = mass_matrix(model.mechanism, standing_pose(model.mechanism))
    assert np.abs(numbers - traced).max() < 1e-14 * np.abs(traced).max()


def test_rotors_as_bodies_and_without_their_mass():
    for figures in ({"eliminate_rotors": False}, {"transmission": "coupled", "locked_rotors": False}):
        model = Model("mit_humanoid_leg", **figures)
        numbers = mass_matrix(model.mechanism, standing_pose(model.mechanism))
        assert numbers == pytest.approx(model.mass_matrix(model.standing_q), rel=1e-12, abs=1e-15)
