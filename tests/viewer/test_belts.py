"""Belts run from the rotor to the joints it drives, and only where gears could not reach."""

from __future__ import annotations

import numpy as np
import pytest

from ce_gym.model import load_robot
from ce_gym.viewer.belts import belt_shapes


@pytest.mark.filterwarnings("ignore")
def test_a_knee_far_from_its_rotor_has_a_belt() -> None:
    shapes = belt_shapes(load_robot("mini_cheetah"))
    assert set(shapes) == {f"{leg}_{body}_link" for leg in ("FR", "FL", "HR", "HL") for body in ("hip", "knee")}
    first, second = shapes["FL_hip_link"]
    for strand in (first, second):
        length, _, _ = strand.size
        assert length == pytest.approx(0.209)
        np.testing.assert_allclose(np.abs(np.array(strand.placement.rotation)[:, 0]), [0, 0, 1], atol=1e-9)
        assert strand.placement.position[2] == pytest.approx(-0.209 / 2)
    (pulley,) = shapes["FL_knee_link"]
    np.testing.assert_allclose(pulley.placement.position, 0, atol=1e-9)
    apart = np.subtract(first.placement.position, second.placement.position)
    assert np.linalg.norm(apart) == pytest.approx(2 * pulley.size[0])


def test_an_ankle_belt_runs_over_the_knee() -> None:
    shapes = {name.removeprefix("right_"): parts for name, parts in belt_shapes(load_robot("mit_humanoid")).items()}
    assert [shape.type for shape in shapes["hip_ry_link"]].count("box") == 4  # of ankle and knee
    assert [shape.type for shape in shapes["knee_link"]].count("box") == 2  # on to the ankle
    assert [shape.type for shape in shapes["knee_link"]].count("cylinder") == 2
    assert [shape.type for shape in shapes["ankle_link"]] == ["cylinder"]
    on = next(shape for shape in shapes["knee_link"] if shape.type == "box")
    assert on.size[0] == pytest.approx(0.2785, abs=1e-3)
