"""What a robot's file says about tasks is checked with the file's name, before anything is traced."""

import pytest
import yaml

from ce_gym import load_robot
from ce_gym.envs.runtime.setup import make_program, own_task
from ce_gym.model import RobotError, assets_folder

FOLDER = assets_folder() / "mini_cheetah"


def edited(tmp_path, **changes):
    """Write Mini Cheetah's file with other top-level keys and return its path."""
    data = yaml.safe_load((FOLDER / "mini_cheetah.yaml").read_text()) | changes
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in data.items() if value is not None}))
    (tmp_path / "mini_cheetah.urdf").write_bytes((FOLDER / "mini_cheetah.urdf").read_bytes())
    return path


@pytest.mark.filterwarnings("ignore::ce_gym.InertiaWarning")
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tasks": {"velocitty": {"dt": 0.01}}}, r"robot\.yaml: tasks is 'velocitty': .*did you mean 'velocity'"),
        ({"tasks": {"velocity": {"dt": -1}}}, r"robot\.yaml: tasks\.velocity: dt=-1"),
        ({"tasks": {"velocity": {"dtt": 1}}}, r"robot\.yaml: tasks\.velocity: .*'dtt'"),
        ({"tasks": {"velocity": {"rewards": {"pose": "x"}}}}, r"robot\.yaml: tasks\.velocity: rewards"),
        ({"tasks": {"velocity": {"rewards": 3}}}, r"robot\.yaml: tasks\.velocity: "),
        ({"gains": None}, r"robot\.yaml: gains\.kp\.HR_abad_link_joint is missing: expected a gain above 0"),
    ],
)
def test_tasks_in_a_file(tmp_path, changes, message):
    path = edited(tmp_path, **changes)
    with pytest.raises(RobotError, match=message) as caught:
        make_program(str(path), "velocity")
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::ce_gym.InertiaWarning")
def test_mappings_in_a_file(tmp_path):
    own = {
        "rewards": {"swerve": -0.2, "track_linear_velocity": {"weight": 2.0, "width": 0.1}},
        "terminations": {"tilt": {"angle": 1.0}, "torso_contact": None},
        "randomise": {"friction": [0.5, 1.0]},
        "self_collisions": [["HR_knee_link", "FR_knee_link"]],
    }
    file = edited(tmp_path, tasks={"velocity": own}, capsules=None)
    robot = load_robot(file)
    task = own_task(robot, "velocity")
    assert task.rewards["track_linear_velocity"] == {"weight": 2.0, "width": 0.1}
    assert task.rewards["swerve"] == -0.2
    assert task.terminations == {"tilt": {"angle": 1.0}, "torso_contact": {}}
    assert task.randomise == {"friction": (0.5, 1.0)}
    assert task.self_collisions == (("HR_knee_link", "FR_knee_link"),)


@pytest.mark.filterwarnings("ignore::ce_gym.InertiaWarning")
def test_a_robot_without_gains_can_have_torques(tmp_path):
    path = str(edited(tmp_path, gains=None))
    assert make_program(path, "velocity", actions="joint_torque").task.actions == "joint_torque"
