"""Joints that springs alone move: no target of whatever kind moves them, and no gain, action or actuator is theirs."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest

import ce_gym
from ce_gym.dynamics.forces.scene import Control, target_names
from ce_gym.envs.task.actions import ActionMap
from ce_gym.envs.task.tasks import TASKS
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import Body, Gains, Inertial, Joint, LinearConstraint, Motor, Placement, Robot

STIFFNESS, INERTIA = 3.0, 0.02
SPRING = {"stiffness": STIFFNESS, "springref": 0.3, "torque": 0.0}


def wheel(name: str, kind: Literal["link", "rotor"] = "link", spin: float = INERTIA, **joint) -> Body:
    """A wheel about a vertical axis."""
    inertia = ((spin, 0.0, 0.0), (0.0, spin, 0.0), (0.0, 0.0, spin))
    return Body(name, kind, None, Placement(), Joint("revolute", **joint), Inertial(0.5, (0.0, 0.0, 0.0), inertia))


def pair(**blade) -> Robot:
    """A wheel with a motor behind a gear of six, and beside it a blade, a spring's unless told otherwise."""
    spring: dict[str, Any] = SPRING | blade
    bodies = (wheel("blade", **spring), wheel("arm", torque=30.0), wheel("rotor", "rotor", 1e-4))
    gear = LinearConstraint("rotor", (("rotor", 1.0), ("arm", -6.0)))
    gains = Gains((("arm", 20.0),), (("arm", 1.0),))
    return Robot("pair", bodies, (gear,), ("blade", "arm"), motors=(Motor("rotor", 5.0),), gains=gains)


def test_a_torque_of_0_makes_a_joint_passive():
    for blade in ({}, {"stiffness": 0.0}):
        robot = pair(**blade)
        assert (robot.passive, robot.driven, robot.commanded) == (("blade",), ("arm",), ("blade", "arm")), blade
    for blade in ({"torque": 2.0}, {"torque": np.inf}):
        assert pair(**blade).passive == (), blade


def test_where_no_joint_has_a_torque_those_with_springs_are_passive():
    idle = [replace(b, joint=replace(b.joint, torque=0.0)) for b in pair().bodies]
    assert replace(pair(), bodies=tuple(idle)).passive == ("blade",)


@pytest.mark.slow
@pytest.mark.parametrize("level", ce_gym.LEVELS)
@pytest.mark.parametrize("control", ["position", "torque", "motor_position", "motor_torque"])
@pytest.mark.parametrize("motors", ["ideal", "limited"])
def test_no_target_moves_it(level: str, control: Control, motors: str):
    """It swings as in closed form for any target and any declared gain; the arm follows its target."""
    model = ce_gym.Model(pair(), level)
    parameters = ("kp",) if control == "position" else ()
    options: dict[str, Any] = {
        "control": control,
        "motors": motors,
        "contacts": (),
        "outputs": (),
        "parameters": parameters,
    }
    sim = ce_gym.Simulator(model, dt=1e-3, method="extrapolated", **options)
    sim.set_state([0.5, 0.0], np.zeros(2))
    if parameters:
        sim.set_parameter("kp", [50.0, 20.0])
    names = target_names(model.mechanism, control)
    sim.step([7.0 if name == "blade" else 1.0 for name in names], 200)
    assert sim.q[0, 0] == pytest.approx(0.3 + 0.2 * np.cos(np.sqrt(STIFFNESS / INERTIA) * 0.2), abs=1e-3)
    assert sim.q[0, 1] > 0.02


def test_it_has_no_action():
    """At the joints, where it has a place among targets, as at the motors."""
    mechanism = ce_gym.Model(pair()).mechanism
    for kind in ("joint_pd", "joint_torque", "motor_pd", "motor_torque"):
        actions = ActionMap(mechanism, replace(TASKS["stand"], actions=kind))
        assert [actions.targets[i] for i in actions.moved] == ["rotor" if kind.startswith("motor") else "arm"]
    with pytest.raises(ValueError, match="expected patterns of joints among arm"):
        ActionMap(mechanism, replace(TASKS["stand"], action_joints=("blade",)))


def test_mjcf_has_no_actuator_of_it():
    root = ET.fromstring(to_mjcf(pair(), "none"))
    assert [actuator.get("joint") for actuator in root.iter("position")] == ["arm"]
    assert [len(key.attrib["ctrl"].split()) for key in root.iter("key")] == [1]


def test_it_is_passive_again_when_mjcf_is_read_back(tmp_path):
    """Every joint without an actuator is passive, with or without a spring; in a file without actuators no joint is."""
    pytest.importorskip("mujoco")
    path = tmp_path / "pair.xml"
    path.write_text(to_mjcf(pair(), "none"))
    again = ce_gym.load_robot(path)
    assert (again.passive, again.driven) == (("blade",), ("arm",))
    assert [name for name, _ in (*again.gains.kp, *again.gains.kd)] == ["arm", "arm"]
    blade = again.body("blade").joint
    assert (blade.stiffness, blade.springref) == (STIFFNESS, 0.3)
    path.write_text(to_mjcf(pair(stiffness=0.0), "none"))
    assert ce_gym.load_robot(path).passive == ("blade",)
    root = ET.fromstring(path.read_text())
    for parent, tag in ((root, "actuator"), (root, "keyframe")):
        parent.remove(next(parent.iter(tag)))
    path.write_text(ET.tostring(root, encoding="unicode"))
    assert ce_gym.load_robot(path).passive == ()
