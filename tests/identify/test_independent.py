"""Identification from logs of an independent controller, and its standard errors against dense least squares.

The robot is text with other numbers, stepped by a bare `Simulator`. A controller of this test commands torques row by
row, which reach the motors whole rows later.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ce_gym import Model, Robot, Simulator, load_robot
from ce_gym.identify import Identified, Log, identify, to_yaml

pytestmark = pytest.mark.slow

pytest.importorskip("scipy")

URDF = """\
<robot name="arm">
  <link name="bench"/>
  <link name="upper"><inertial><origin xyz="0 0 -0.1"/><mass value="0.8"/>
    <inertia ixx="0.004" ixy="0" ixz="0" iyy="{upper}" iyz="0" izz="0.002"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.08"/><mass value="0.3"/>
    <inertia ixx="{lower}" ixy="0" ixz="0" iyy="{lower}" iyz="0" izz="0.0005"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="bench"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.25"/>
    <axis xyz="0 1 0"/></joint>
</robot>
"""
YAML = """\
urdf: arm.urdf
base: fixed
rotors:
  first: {{parent: bench, xyz: [0, 0, 0], axis: [0, 1, 0], mass: 0.1, ratios: {{upper: 6}},
    inertia: [1e-4, 0, 0, {first}, 0, 1e-4]}}
  second: {{parent: upper, xyz: [0, 0, -0.25], axis: [0, 1, 0], mass: 0.1, ratios: {{lower: 9}},
    inertia: [1e-4, 0, 0, {second}, 0, 1e-4]}}
motors: {{first: {{torque: 5, friction: {first_friction}}}, second: {{torque: 5, friction: {second_friction}}}}}
"""
SPIN, UPPER, LOWER = 6e-5, 5e-3, 2e-3
SHARE = 6**2 * SPIN / UPPER
"""First rotor and upper link only ever turn together: one of the rotor's factor is worth so much of the link's."""
PLANTED = {
    "rotor_inertia:second": 0.8,
    "motor_friction:first": 0.03,
    "motor_friction:second": 0.02,
    "link_inertia:upper": 1 + SHARE * 0.25,
    "link_inertia:lower": 1.3,
    "delay": 0.008,
}
DT, LATE, NOISE = 0.004, 2, 3e-4


def written(folder: Path, first=1.0, second=1.0, lower=1.0, frictions=(0.01, 0.01)) -> Robot:
    """Return the arm with other numbers; a factor on a rotor's spin inertia does not change its load on the carrier."""
    spins = {"first": first * SPIN, "second": second * SPIN}
    links = {"upper": UPPER - (second - 1) * SPIN, "lower": lower * LOWER}
    (folder / "arm.urdf").write_text(URDF.format(**links))
    (folder / "arm.yaml").write_text(
        YAML.format(**spins, first_friction=frictions[0], second_friction=frictions[1]), encoding="utf-8"
    )
    return load_robot(folder / "arm.yaml")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Log, np.ndarray]:
    """A log of the arm with planted parameters, and its states, shape (T, 4)."""
    robot = written(tmp_path_factory.mktemp("real"), 1.25, 0.8, 1.3, (0.03, 0.02))
    sim = Simulator(Model(robot), 1, DT / 4, control="torque", motors="limited", method="extrapolated")
    states, torques = np.zeros((1100, 4)), np.zeros((1100, 2))
    for k in range(len(states)):
        states[k] = np.r_[sim.q[0], sim.v[0]]
        t = k * DT
        goal = [0.6 * np.sin(6 * t + 1.2 * t**2), 0.8 * np.sin(20 * t - 1.5 * t**2)]  # no joint sticks for long
        torques[k] = [8, 5] * (goal - states[k, :2]) - [0.4, 0.2] * states[k, 2:]
        sim.step(torques[max(0, k - LATE)], 4)
    angles = states[:, :2] + np.random.default_rng(5).normal(0, NOISE, (len(states), 2))
    measured = (("angle", "upper"), ("angle", "lower"))
    return Log(DT, ("upper", "lower"), torques, measured, angles), states


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return written(tmp_path_factory.mktemp("file"))


@pytest.fixture(scope="module")
def result(run: tuple[Log, np.ndarray], plain: Robot) -> Identified:
    kinds = ("rotor_inertia", "motor_friction", "link_inertia", "delay")
    return identify(plain, run[0], control="torque", kinds=kinds)


def test_estimates_are_the_parameters_of_the_other_robot(result: Identified):
    std = dict(zip([parameter.name for parameter in result.parameters], result.std, strict=True))
    for name, value in PLANTED.items():
        assert result[name] == pytest.approx(value, rel=0.02), name
        assert abs(result[name] - value) < 4 * std[name], name
    assert result.held_out.max() < 1.1 * NOISE


def test_of_inseparable_parameters_the_sum_is_estimated(result: Identified):
    assert [item.parameter.name for item in result.unidentifiable] == ["rotor_inertia:first"]
    assert result["rotor_inertia:first"] == 1.0
    line, text = result.warnings[0], to_yaml(result, "arm.yaml")
    assert line.startswith(
        "rotor_inertia:first is held at 1, as in the robot's file: the data cannot separate it from "
    )
    assert f"link_inertia:upper + {SHARE:.3g}" in line
    assert f"is {result['link_inertia:upper']:.5g}, " in line
    assert '"upper"' in text
    assert line in text
    assert '"first"' not in text.split("  rotor_inertia:")[1].split("  motor")[0]


def test_standard_errors_are_those_of_dense_least_squares(
    result: Identified, run: tuple[Log, np.ndarray], plain: Robot
):
    """Parameters and all initial states at once, with the Jacobian by central differences at planted parameters."""
    log, states = run
    first, length = np.arange(9, 1100 - 125, 125)[:-2], 125  # 30 ms and a row, then half a second each, two held out
    assert result.curves[0][0, 0] == pytest.approx((first[-1] + length) * DT)
    names = [result.parameters[i].name for i in result.estimated]
    factors = ("rotor_inertia:second", "link_inertia:upper", "link_inertia:lower")
    options = {"control": "torque", "motors": "limited", "method": "extrapolated", "contacts": (), "outputs": ()}
    sim = Simulator(Model(plain), len(first), DT / 4, parameters=(*factors, "motor_friction"), **options)

    def angles(parameters: dict[str, float], moved: np.ndarray) -> np.ndarray:
        """Windows after each other, each its two angles row by row."""
        for name in factors:
            sim.set_parameter(name, parameters[name])
        sim.set_parameter("motor_friction", [parameters["motor_friction:first"], parameters["motor_friction:second"]])
        start = states[first] + moved
        late, rest = divmod(4 * parameters["delay"] / DT, 1)  # in sub-steps; each has the mean of its commands
        sim.set_state(start[:, :2], start[:, 2:])
        read = [sim.q.copy()]
        for k in range(4 * (length - 1)):
            due, earlier = (log.commands[first + (k - int(late) - i) // 4] for i in (0, 1))
            sim.step((1 - rest) * due + rest * earlier)
            read.append(sim.q.copy())
        return np.stack(read[::4], axis=1).ravel()

    still = np.zeros((len(first), 4))
    steps = {name: 1e-4 * value for name, value in PLANTED.items()}
    columns = []
    for name in names:
        up, down = (angles(PLANTED | {name: PLANTED[name] + sign * steps[name]}, still) for sign in (1, -1))
        columns.append((up - down) / (2 * steps[name]))
    for k in range(still.size):
        moved = np.zeros(still.size)
        moved[k] = 1e-5
        moved = moved.reshape(still.shape)
        columns.append((angles(PLANTED, moved) - angles(PLANTED, -moved)) / 2e-5)
    J = np.column_stack(columns)
    std = NOISE * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[: len(names)]
    np.testing.assert_allclose(result.noise, NOISE, rtol=0.05)
    np.testing.assert_allclose(result.std[result.estimated], std, rtol=0.05)
