"""Names that match nothing are refused wherever names or patterns are listed: one line, near matches, what exists."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

import ce_gym
from ce_gym.envs.runtime.setup import make_program
from ce_gym.identify.parameters import select_parameters
from ce_gym.model.errors import RobotError, check_names, listed_names

CHEETAH = ce_gym.Model("mini_cheetah")
JOINT = CHEETAH.joint_links[0]
BASE = CHEETAH.robot.bodies[0].name


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action_joints": [JOINT, "FL_hip_joint"]}, "action_joints='FL_hip_joint'; .* mean 'FL_hip_link_joint'"),
        ({"action_joints": [JOINT, "*_elbow_link"]}, r"action_joints='\*_elbow_link'; expected patterns of joints"),
        ({"action_joints": [JOINT, "fl_knee_link"]}, "action_joints='fl_knee_link'; .* mean 'FL_knee_link'"),
        ({"action_joints": ["FL_knee_rotor"]}, "action_joints='FL_knee_rotor'; .* mean 'FL_knee_link_joint'"),
        ({"action_joints": ["[AB]_knee"], "actions": "motor_pd"}, r"action_joints='\[AB\]_knee'; .*that motors drive"),
        ({"action_joints": [JOINT, JOINT]}, f"action_joints='{JOINT}' is listed twice"),
        ({"action_joints": []}, r"action_joints=\(\); expected patterns of joints among HR"),
        ({"contacts": ["foot", "kne"]}, "contacts='kne'; .* mean 'knee'"),
        ({"contacts": ["foot", "foot"]}, "contacts='foot' is listed twice"),
        ({"randomise": {"frictoin": (0.5, 1)}}, "randomise='frictoin'; .* mean 'friction'"),
        (
            {"randomise": {"added_mass:FL_hip": (0, 1)}},
            "randomise='added_mass:FL_hip'; .* mean 'added_mass:FL_hip_link'",
        ),
        ({"randomise": {"kp:FL_hip_link": (0.5, 1)}}, "randomise='kp:FL_hip_link'; expected one of"),
        ({"randomise": {"com_shift": (0, 0), f"com_shift:{BASE}": (0, 0)}}, f"randomise='com_shift:{BASE}' is listed"),
        ({"observations": ["joint_position"]}, "no observation term 'joint_position'; .* mean 'joint_positions'"),
        ({"observations": ["gyro", "gyro"]}, "observations='gyro' is listed twice"),
        ({"terminations": ["tilt", "tilt"]}, "terminations='tilt' is listed twice"),
        ({"critic": ["base_height", "base_height"]}, "critic='base_height' is listed twice"),
        ({"rewards": {"orientatio": 0}}, "no reward term 'orientatio'; .* mean 'orientation'"),
        ({"noise": {"joint_position": 0.1}}, "noise='joint_position'; .* mean 'joint_positions'"),
        ({"observations": {"gyro": {"link": "FL_hip"}}}, "'gyro': link='FL_hip'; .* mean 'FL_hip_link'"),
        ({"observations": {"gyro": {"lnk": ""}}}, "parameter 'lnk'; expected one of link, .* mean 'link'"),
        ({"terrain": {"kind": "stairs", "riise": 0.1}}, r"terrain\['riise'\]=0.1; .* mean 'rise'"),
        (
            {"self_collisions": [["FL_foot", "FR_knee_link"]]},
            "self_collisions='FL_foot'; expected a link with capsules",
        ),
        (
            {"self_collisions": [["FL_knee_link", "FR_knee_link"], ["FR_knee_link", "FL_knee_link"]]},
            "self_collisions='FL_knee_link and FR_knee_link' is listed twice",
        ),
        ({"action_joint": ["*"]}, "unexpected keyword argument 'action_joint'; .* mean 'action_joints'"),
    ],
)
def test_tasks_refuse_names_that_match_nothing(options: dict, message: str):
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        make_program("mini_cheetah", "stand", **options)
    assert "\n" not in str(caught.value)


def test_patterns_may_overlap_and_motors_take_joints_that_they_drive():
    assert make_program("mini_cheetah", "stand", action_joints=["*hip*", "FL_*"]).n_actions == 6
    assert make_program("mini_cheetah", "stand", action_joints=["*hip*"], actions="motor_pd").n_actions == 4
    passive = ce_gym.load_robot("cassie").passive[0]
    with pytest.raises(ValueError, match=f"action_joints='{passive}'; expected patterns of joints among"):
        make_program("cassie", "stand", action_joints=["*_hip_*", passive])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"contacts": "*foot"}, r"contacts='\*foot'; expected 'all', groups or names among"),
        ({"contacts": ("foot", 3)}, "contacts=3; expected 'all', groups or names among"),
        ({"contacts": ("knee", "knee")}, "contacts='knee' is listed twice"),
        ({"outputs": ("torque", "energi")}, "outputs='energi'; .* mean 'energy'"),
        ({"outputs": "torque"}, "outputs='torque'; expected a list of names"),
        ({"outputs": ("torque", "torque")}, "outputs='torque' is listed twice"),
        ({"parameters": ("friction", "friction")}, "parameters='friction' is listed twice"),
        (
            {"parameters": ("rotor_inertia:FL_hip_link",)},
            "parameters='rotor_inertia:FL_hip_link'; .* mean 'rotor_inert",
        ),
        ({"parameters": "friction"}, "parameters='friction'; expected a list of names"),
        ({"control": "positon"}, "control='positon'; .* mean 'position'"),
    ],
)
def test_simulators_refuse_names_that_match_nothing(options: dict, message: str):
    with pytest.raises(ValueError, match=message):
        ce_gym.Simulator(CHEETAH, **options)


def test_models_refuse_names_that_match_nothing():
    q, v = CHEETAH.standing_q, np.zeros(CHEETAH.nv)
    with pytest.raises(ValueError, match="wrenches='FL_foot'; expected the name of a body of mini_cheetah: "):
        CHEETAH.forward_dynamics(q, v, v, {"FL_foot": np.zeros(6)})
    with pytest.raises(ValueError, match=f"actuated='{JOINT}' is listed twice"):
        CHEETAH.actuator_matrix(q, [JOINT, JOINT])
    with pytest.raises(ValueError, match="wrt='q' is listed twice"):
        CHEETAH.derivatives("forward_dynamics", ["q", "q"])
    with pytest.raises(ValueError, match="wrt='tau'; expected a list of names"):
        CHEETAH.derivatives("forward_dynamics", "tau")


@pytest.mark.parametrize(
    ("kinds", "fixed", "message"),
    [
        (["delay", "delay"], [], "kind is 'delay': expected each name once"),
        (["delay", "backlash"], [], "kind is 'backlash': expected a kind that mini_cheetah and its log have"),
        (["delay", "rotor_inertai"], [], "kind is 'rotor_inertai': .* mean 'rotor_inertia'"),
        (["rotor_inertia"], ["rotor_inertia:FL_hip"], "fixed is 'rotor_inertia:FL_hip': .* mean 'rotor_in"),
        (["rotor_inertia", "delay"], ["delay", "delay"], "fixed is 'delay': expected each name once"),
    ],
)
def test_identify_refuses_names_that_match_nothing(kinds: list[str], fixed: list[str], message: str):
    with pytest.raises(RobotError, match=message):
        select_parameters(CHEETAH.robot, kinds, fixed)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gains": {"kp": {"*": 1, "FL_hip_joint": 2}, "kd": 1}}, "gains.kp is 'FL_hip_joint': .* mean 'FL_hip_link'"),
        ({"gains": {"kp": {"*": 1, "*_elbow": 2}, "kd": 1}}, r"gains.kp is '\*_elbow': expected a pattern that fits"),
        ({"motors": {"*_elbow": {"torque": 1, "velocity": 1}}}, r"motors is '\*_elbow': expected the name of a rotor"),
        (
            {"self_collisions": [["FL_knee_link", "FR_knee_link"], ["FR_knee_link", "FL_knee_link"]]},
            "self_collisions is 'FL_knee_link and FR_knee_link': expected a name that is used once",
        ),
        ({"kept_inertia": ["*_hip_link", "*_hip_link"]}, "kept_inertia is .*: expected a name that is used once"),
        ({"kept_inertia": ["FL_hipp_link"]}, "kept_inertia is 'FL_hipp_link': .* mean 'FL_hip_link'"),
    ],
)
def test_robot_files_refuse_names_that_match_nothing(tmp_path: Path, changes: dict, message: str):
    source = Path(ce_gym.load_robot("mini_cheetah").source)
    content = {**yaml.safe_load(source.read_text()), "urdf": str(source.with_suffix(".urdf")), **changes}
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    with pytest.raises(RobotError, match=message):
        ce_gym.load_robot(tmp_path / "robot.yaml")


@pytest.mark.parametrize(
    ("term", "message"),
    [
        (lambda s: s.touching("elbow").numel() + s.q[0], "group='elbow'; expected a group of contacts among"),
        (lambda s: s.foot_hights[0], "no attribute 'foot_hights' of TermContext; .* mean 'foot_heights'"),
        (lambda s: s.kinematics.bodies["FL_hip"].R[0, 0], "no key 'FL_hip'; bodies are .* mean 'FL_hip_link'"),
        (lambda s: s.mechanism.robot.body("FL_hip").joint.damping, ": mini_cheetah has no body 'FL_hip'; it has"),
    ],
)
def test_terms_of_users_refuse_names_that_match_nothing(monkeypatch, term, message: str):
    from ce_gym.envs.terms import registry

    monkeypatch.setitem(registry._added["reward"], "mine", term)
    with pytest.raises(ValueError, match=message) as caught:
        make_program("mini_cheetah", "stand", rewards={"mine": 1.0})
    assert "\n" not in str(caught.value)


def test_listed_names_say_what_exists_and_what_is_near():
    assert listed_names("hpi", ["hip", "knee"]) == "hip, knee (did you mean 'hip'?)"
    assert listed_names("*_HIP", ["l_hip"]) == "l_hip (did you mean 'l_hip'?)"
    assert listed_names("x", []) == "none: there are none"
    assert listed_names("x", map(str, range(100))).endswith("58, 59 and 40 more")
    check_names("joints", ["*_a", "l_*"], ["l_a", "r_a"], "joints among", patterns=True)
    with pytest.raises(ValueError, match=r"joints='\*_a' is listed twice; expected each name once"):
        check_names("joints", ["*_a", "*_a"], ["l_a", "r_a"], "joints among", patterns=True)
    with pytest.raises(ValueError, match="joints='l_a'; expected a list of names"):
        check_names("joints", "l_a", ["l_a"], "joints among")
