"""Robot files of others: MuJoCo and Pinocchio find the same robot in them. `--folder` names files of your own."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import robot_files

pytest.importorskip("mujoco")
pytest.importorskip("pinocchio")
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.LossyImportWarning")
ROOT = Path(__file__).parents[2]
LINK = '<inertial pos="0.1 0.02 0" mass="2" fullinertia="0.02 0.03 0.04 0.001 -0.002 0.003"/>'
MJCF = f"""<mujoco><worldbody><body name="trunk" pos="0 0 1"><freejoint/>{LINK}
<body name="leg" quat="1 0.2 0 0.1"><joint name="a" axis="0 1 0" armature="0.1"/><joint name="b" axis="1 0 0"/>{LINK}
<body name="toe" pos="0 0 -0.4"><joint name="c" type="slide" axis="0 0 1"/>{LINK}</body></body></body></worldbody>
<keyframe><key qpos="0 0 1 1 0 0 0 0 0 0"/></keyframe></mujoco>"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "hopper.xml").write_text(MJCF)
    ball = MJCF.replace('type="slide" axis="0 0 1"', 'type="ball" pos="0.05 0 0.1"').replace(
        '0 0 0"/></k', '0 0 1 0 0 0"/></k'
    )
    (tmp_path / "balls.xml").write_text(ball)
    (tmp_path / "nameless.xml").write_text(re.sub(r' name="[a-z]+"', "", MJCF))
    twins = MJCF.replace('name="b"', 'name="leg"').replace('name="c"', 'name="locked"')
    hold = '<equality><joint joint1="locked" polycoef="0.1 0 0 0 0"/></equality></mujoco>'
    (tmp_path / "locked.xml").write_text(twins.replace("</mujoco>", hold))
    (tmp_path / "two.xml").write_text(
        MJCF.replace("</worldbody>", f'<body name="b"><freejoint/>{LINK}</body></worldbody>')
    )
    (tmp_path / "dragged.xml").write_text(MJCF.replace("<freejoint/>", '<joint type="free" armature="0.1"/>'))
    (tmp_path / "scene.xml").write_text('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    shutil.copy(ROOT / "tests" / "data" / "own_robot" / "pup.urdf", tmp_path)
    return tmp_path


def test_peers_find_the_same_robots(folder, monkeypatch):
    found = {path.name: robot_files.outcome(path) for path in robot_files.files(folder)}
    joints = {"hopper.xml": 3, "nameless.xml": 3, "locked.xml": 2, "balls.xml": 2, "dragged.xml": 3, "pup.urdf": 8}
    assert set(found) == {*joints, "two.xml"}, "a scene without a robot is no robot"
    for name, number in joints.items():
        assert (found[name].text, found[name].joints) == ("same", number)
        assert len(found[name].errors) == 3
    assert found["two.xml"].text.endswith("expected one robot, so at most one free joint")
    load = robot_files.load_robot

    def heavier(path):
        """The same robot with a toe that is a gram heavier."""
        robot = load(path)
        *bodies, toe = [body for body in robot.bodies if body.kind == "link"]
        toe = replace(toe, inertial=replace(toe.inertial, mass=toe.inertial.mass + 1e-3))
        return replace(robot, bodies=(*bodies, toe, *robot.rotors()))

    monkeypatch.setattr(robot_files, "load_robot", heavier)
    assert robot_files.outcome(folder / "hopper.xml").text == "DIFFERS"


@pytest.mark.stress
@pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")
def test_files_of_a_folder(request):
    """Files of a folder, a checkout of MuJoCo Menagerie for example."""
    folder = request.config.getoption("--folder")
    if folder is None:
        pytest.skip("no folder; expected --folder FOLDER")
    found = {path.relative_to(folder): robot_files.outcome(path) for path in robot_files.files(folder)}
    for path, outcome in found.items():
        print(f"{path}: {outcome.text}")
    assert not [path for path, outcome in found.items() if outcome.text == "DIFFERS"]
