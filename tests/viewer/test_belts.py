"""Belts run from the rotor to the joints it drives, and only where gears could not reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ce_gym.model import load_robot
from ce_gym.model.constraints import LinearConstraint
from ce_gym.viewer.page.belts import belt_parts


@pytest.mark.filterwarnings("ignore")
def test_a_knee_far_from_its_rotor_has_a_belt() -> None:
    shapes = {name: [part.shape for part in parts] for name, parts in belt_parts(load_robot("mini_cheetah")).items()}
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
    parts = {name.removeprefix("right_"): parts for name, parts in belt_parts(load_robot("mit_humanoid")).items()}
    shapes = {name: [part.shape for part in here] for name, here in parts.items()}
    assert [shape.type for shape in shapes["hip_ry_link"]].count("box") == 4  # of ankle and knee
    assert [shape.type for shape in shapes["knee_link"]].count("box") == 2  # on to the ankle
    assert [shape.type for shape in shapes["knee_link"]].count("cylinder") == 2
    assert [shape.type for shape in shapes["ankle_link"]] == ["cylinder"]
    on = next(shape for shape in shapes["knee_link"] if shape.type == "box")
    assert on.size[0] == pytest.approx(0.2785, abs=1e-3)
    # The belt of the ankle's rotor turns with both joints on the thigh, with the ankle alone on the shank.
    knee, ankle = ("right_knee_link", 1), ("right_ankle_link", 1)
    assert {part.links for part in parts["hip_ry_link"]} == {(knee, ankle), (knee,)}
    assert [part.links for part in parts["knee_link"] if part.shape.type == "box"] == [(ankle,)] * 2
    assert sorted(part.links for part in parts["knee_link"] if part.shape.type == "cylinder") == [(), (ankle,)]


def test_strands_run_as_the_pulley_turns() -> None:
    """A point of the driven pulley, where the strand leaves it, moves as fast as the strand."""
    robot = load_robot("mini_cheetah")
    knee = robot.body("FL_knee_link")
    (pulley,) = belt_parts(robot)["FL_knee_link"]
    axis, centre = np.array(knee.placement.rotation) @ knee.joint.axis, np.array(knee.placement.position)
    for strand in belt_parts(robot)["FL_hip_link"]:
        along, side, _ = np.array(strand.shape.placement.rotation).T
        touches = centre - axis * (axis @ (centre - strand.shape.placement.position))
        lever = np.array(strand.shape.placement.position) - touches
        lever -= along * (along @ lever)
        assert np.linalg.norm(lever) == pytest.approx(pulley.shape.size[0])
        assert abs(lever @ side) == pytest.approx(pulley.shape.size[0])
        np.testing.assert_allclose(np.cross(axis, lever), strand.reach * along, atol=1e-9)


@pytest.mark.parametrize("name", ["tello", "tello_with_arms", "jvrc1", "four_bar"])
def test_differentials_and_gears_are_no_belts(name: str) -> None:
    assert belt_parts(load_robot(name)) == {}


def test_a_rotor_that_turns_otherwise_has_no_belt() -> None:
    robot = load_robot("mit_humanoid")

    def changed(constraint: LinearConstraint) -> LinearConstraint:
        pairs = [(n, -c if n.endswith("ankle_link") else c) for n, c in constraint.coefficients]
        return replace(constraint, coefficients=tuple(pairs))

    constraints = tuple(changed(c) if isinstance(c, LinearConstraint) else c for c in robot.constraints)
    parts = belt_parts(replace(robot, constraints=constraints))
    assert set(parts) == {f"{side}_{body}_link" for side in ("right", "left") for body in ("hip_ry", "knee")}
    assert {part.links for part in parts["right_hip_ry_link"]} == {(("right_knee_link", 1),)}
