"""URDF+: the paper authors' own files, unchanged, against their library's results on its own random states."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from ce_gym.dynamics import Model
from ce_gym.model import LinearConstraint, LoopConstraint, RobotError, load_robot

DATA = Path(__file__).parents[1] / "data"
TOLERANCE = 1e-10
# file and reference states; the base of the first is called differently in no way, so names compare directly
FILES = {"mini_cheetah": "mini_cheetah", "mit_humanoid_leg": "mit_humanoid_leg_urdf", "four_bar": "four_bar"}
pytestmark = pytest.mark.filterwarnings("ignore::ce_gym.model.InertiaWarning")


def file(name: str) -> Path:
    return DATA / "urdf_plus" / f"{name}.urdf"


class Reference:
    """The library's states in the order of our coordinates."""

    def __init__(self, name: str):
        self.robot = load_robot(file(name))
        data = json.loads((DATA / "vectors" / f"{FILES[name]}.json").read_text())
        states, self.base = data["states"], 6 if self.robot.floating else 0
        order = [body for body in data["spanning_joint_order"] if self.robot.body(body).joint.type != "free"]
        independent = [
            body for cluster in data["clusters"] for body in cluster["bodies"] if body in self.robot.independent
        ]
        joints = [order.index(body) for body in self.robot.independent]
        self.positions = [*range(self.base + bool(self.base)), *(self.base + bool(self.base) + j for j in joints)]
        self.velocities = [*range(self.base), *(self.base + independent.index(b) for b in self.robot.independent)]
        self.dependent = [b for b in order if b not in self.robot.independent]
        self.q = np.array([state["q_span"] for state in states])[:, self.positions]
        self.all_q = np.array([state["q_span"] for state in states])
        self.order, self.states = order, states

    def __getitem__(self, key: str) -> np.ndarray:
        values = np.array([state[key] for state in self.states if key in state])[..., self.velocities]
        return values[..., self.velocities, :] if key == "H" else values


def error(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))


@pytest.mark.parametrize("name", ["mini_cheetah", "mit_humanoid_leg"])
def test_geared_robots_have_the_library_s_dynamics(name):
    reference = Reference(name)
    model = Model(reference.robot)
    v, H = reference["yd"], reference["H"]
    assert len(v) >= 10
    assert error(model.forward_dynamics(reference.q, v, reference["tau"]), reference["ydd"]) < TOLERANCE
    assert error(model.inverse_dynamics(reference.q, v, reference["id_ydd"]), reference["id_tau"]) < TOLERANCE
    assert error(model.mass_matrix(reference.q[: len(H)]), H) < TOLERANCE


def test_the_four_bar_has_the_library_s_dynamics():
    """Its states lie on either branch; `assembly` chooses ours."""
    reference = Reference("four_bar")
    for i, state in enumerate(reference.states):
        angles = dict(zip(reference.order, state["q_span"], strict=True))
        robot = dataclasses.replace(
            reference.robot,
            pose=dataclasses.replace(reference.robot.pose, joints=(("link1", angles["link1"]),)),
            assembly=tuple((body, angles[body]) for body in reference.dependent),
        )
        model = Model(robot)
        q, v = reference.q[i], reference["yd"][i]
        assert error(model.forward_dynamics(q, v, reference["tau"][i]), reference["ydd"][i]) < TOLERANCE
        assert error(model.mass_matrix(q), reference["H"][i]) < TOLERANCE
        assert error(model.inverse_dynamics(q, v, reference["id_ydd"][i]), reference["id_tau"][i]) < TOLERANCE


def test_what_the_files_say():
    cheetah, leg, bars = (load_robot(file(name)) for name in FILES)
    assert cheetah.floating
    assert not leg.floating
    assert len(list(cheetah.rotors())) == 12
    assert [body.name for body in leg.rotors()] == [
        f"{j}_rotor" for j in ("hip_rz", "hip_rx", "hip_ry", "knee", "ankle")
    ]
    ankle = leg.constraints[-1]
    assert isinstance(ankle, LinearConstraint)
    assert dict(ankle.coefficients) == {"ankle_rotor": 1.0, "knee_link": -12.0, "ankle_link": -12.0}, "sums along paths"
    assert bars.independent == ("link1",)
    assert not list(bars.rotors())
    (loop,) = bars.constraints
    assert isinstance(loop, LoopConstraint)
    assert (loop.first, loop.second, loop.joint) == ("link2", "link3", "revolute")
    assert (loop.first_placement.position, loop.second_placement.position) == ((1.0, 0.0, 0.0), (0.5, 0.0, 0.0))


@pytest.fixture
def variant(tmp_path):
    """Return a function that writes a reference file with edits."""

    def write(name: str, *edits: tuple[str, str]) -> Path:
        text = file(name).read_text()
        for old, new in edits:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / "r.urdf").write_text(text)
        return tmp_path / "r.urdf"

    return write


def test_the_base_can_be_chosen(tmp_path, variant):
    assert load_robot(variant("four_bar"), floating=False) == load_robot(file("four_bar"))
    mass = '<link name="base_link"><inertial><mass value="2"/>'
    mass += '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    heavy = variant("four_bar", ('<link name="base_link"/>', mass))
    assert load_robot(heavy).floating
    assert load_robot(heavy, floating=True).floating
    assert not load_robot(heavy, floating=False).floating
    with pytest.raises(RobotError, match="base_link' <inertial> is missing"):
        load_robot(file("four_bar"), floating=True)
    with pytest.raises(RobotError, match="floating is True: expected None"):
        load_robot("mini_cheetah", floating=True)


def test_a_lopsided_leaf_without_the_name_is_no_rotor(variant):
    finger = variant(
        "mit_humanoid_leg",
        ('<link name="ankle_rotor">', '<link name="finger">'),
        ('<child link="ankle_rotor"/>', '<child link="finger"/>'),
        ('<successor link="ankle_rotor"/>', '<successor link="finger"/>'),
    )
    assert load_robot(finger).body("finger").kind == "rotor", "symmetric about its axis"
    lopsided = finger.read_text().rsplit('iyy="1.6841e-4" iyz="0.0" izz="1.084e-4"', 1)
    finger.write_text(
        'iyy="1.6841e-4" iyz="0.0" izz="1.2e-4"'.join(lopsided).replace('<mass value="0."/>', '<mass value=".1"/>')
    )
    assert load_robot(finger).body("finger").kind == "link"


def test_a_yaml_file_beside_a_plain_urdf_is_found(tmp_path, write_robot):
    path = write_robot()
    assert load_robot(path.with_suffix(".urdf")) == load_robot(path)
    path.write_text(path.read_text().replace("urdf: leg.urdf", "urdf: other.urdf"))
    shutil.copy(path.with_suffix(".urdf"), tmp_path / "other.urdf")
    assert not list(load_robot(path.with_suffix(".urdf")).rotors()), "it belongs to another URDF"


def test_a_yaml_file_does_not_hide_the_couplings_of_urdf_plus(tmp_path):
    shutil.copy(file("four_bar"), tmp_path / "four_bar.urdf")
    (tmp_path / "four_bar.yaml").write_text("urdf: four_bar.urdf\n")
    assert load_robot(tmp_path / "four_bar.urdf").constraints
    with pytest.raises(RobotError, match=r"URDF\+.*expected a plain URDF"):
        load_robot(tmp_path / "four_bar.yaml")
