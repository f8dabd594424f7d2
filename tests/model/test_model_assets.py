"""The robots that come with the package carry the published figures, and are found wherever they are installed."""

import math
import os
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import ce_gym.model
from ce_gym.model import InertiaWarning, Robot, RobotError, cluster_tree, load_robot, robots
from ce_gym.model.checks.robot import _warn_of_inertia, check_robot

FACTS = Path(__file__).resolve().parents[1] / "data" / "facts"
NAMES = ["mini_cheetah", "mit_humanoid_leg"]


@pytest.fixture(params=NAMES)
def name(request) -> str:
    return request.param


@pytest.fixture
def robot(name) -> Robot:
    return load_robot(name)


@pytest.fixture
def facts(name) -> dict:
    return yaml.safe_load((FACTS / f"{name}.yaml").read_text(encoding="utf-8"))


def rotation(rpy) -> np.ndarray:
    """An independent Rz Ry Rx."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


def test_bodies_are_the_published_ones(robot, facts):
    assert {body.name for body in robot.bodies} == {body["name"] for body in facts["bodies"]}
    for fact in facts["bodies"]:
        body = robot.body(fact["name"])
        assert body.kind == ("rotor" if fact["kind"] == "rotor" else "link")
        assert (body.parent or "ground") == fact["parent"]
        assert body.joint.type == fact["joint"]["type"]
        assert body.placement.position == tuple(fact["placement"]["xyz"])
        np.testing.assert_allclose(body.placement.rotation, rotation(fact["placement"]["rpy"]), atol=1e-15)
        if body.joint.type != "free":
            assert body.joint.axis == tuple(fact["joint"]["axis"])


def test_mass_properties_are_the_published_ones(robot, facts):
    for fact in facts["bodies"]:
        inertial = robot.body(fact["name"]).inertial
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = inertial.inertia
        assert inertial.mass == fact["inertial"]["mass"]
        assert inertial.com == tuple(fact["inertial"]["com"])
        assert [xx, xy, xz, yy, yz, zz] == fact["inertial"]["inertia"]
        assert (yx, zx, zy) == (xy, xz, yz)
    assert robot.total_mass == pytest.approx(facts["counts"]["total_mass"], abs=1e-12)


def test_limits_are_the_published_ones(robot, facts):
    for link, limits in facts["limits"]["joints"].items():
        joint = robot.body(link).joint
        assert joint.position == tuple(limits["position"])
        assert joint.velocity == limits["velocity"]
        assert joint.torque == pytest.approx(limits["torque"], abs=0.011)  # 27.99 = 3 N m * 9.33 is published as 28


def test_motors_reach_the_joint_torques(robot):
    """Joint torque = sum over its motors of ratio * motor torque, unless a belt couples joints."""
    ratios = {constraint.name: dict(constraint.coefficients) for constraint in robot.constraints}
    for motor in robot.motors:
        links = {link: -ratio for link, ratio in ratios[motor.rotor].items() if link != motor.rotor}
        for link, ratio in links.items():
            alone = sum(link in other for other in ratios.values()) == 1
            if alone and len(links) == 1:
                assert motor.torque * ratio == pytest.approx(robot.body(link).joint.torque, rel=1e-12)
    assert len(robot.motors) == len(list(robot.rotors()))


def test_cluster_tree_is_the_published_one(robot, facts):
    tree = cluster_tree(robot)
    assert len(tree.clusters) == facts["counts"]["clusters"]
    by_name = {fact["name"]: fact for fact in facts["clusters"]}
    for fact in facts["clusters"]:
        cluster = tree.clusters[tree.cluster_of(fact["bodies"][0])]
        assert set(cluster.bodies) == set(fact["bodies"])
        assert list(cluster.independent) == fact["constraint"].get("independent", [])
        if fact["parent_cluster"] is None:
            assert cluster.parent is None
        else:
            parent = tree.clusters[cluster.parent]
            assert set(parent.bodies) == set(by_name[fact["parent_cluster"]]["bodies"])
    assert [set(cluster.bodies) for cluster in tree.clusters] == [set(fact["bodies"]) for fact in facts["clusters"]]


def test_ratios_are_the_published_ones(robot, facts):
    """The published rows K q = 0 and our constraints have the same null space: G spans it."""
    tree = cluster_tree(robot)
    for fact in facts["clusters"]:
        if fact["constraint"]["type"] != "linear":
            continue
        cluster = tree.clusters[tree.cluster_of(fact["bodies"][0])]
        K = np.array([[dict(c.coefficients).get(b, 0.0) for b in fact["bodies"]] for c in cluster.constraints])
        np.testing.assert_array_equal(K @ np.array(fact["constraint"]["G"]), 0.0)
        assert len(K) == len(fact["bodies"]) - fact["n_independent"]


def test_right_angles_are_exact():
    mini_cheetah = load_robot("mini_cheetah")
    assert mini_cheetah.body("FL_hip_link").placement.rotation == ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))


def test_feet_just_touch_in_the_standing_pose():
    """The planar leg by hand: hip and knee axes are -y of the body, so that the shank hangs at hip + knee."""
    mini_cheetah = load_robot("mini_cheetah")
    angles = dict(mini_cheetah.pose.joints)
    for foot in (contact for contact in mini_cheetah.contacts if contact.group == "foot"):
        leg = foot.name[:2]
        thigh, shank = angles[f"{leg}_hip_link"], angles[f"{leg}_hip_link"] + angles[f"{leg}_knee_link"]
        height = mini_cheetah.pose.height - 0.209 * math.cos(thigh) + foot.position[2] * math.cos(shank)
        assert height == pytest.approx(foot.radius, abs=1e-6)
    assert sorted({contact.group for contact in mini_cheetah.contacts}) == ["foot", "knee", "torso"]
    assert len(mini_cheetah.contacts) == 4 + 4 + 8


def test_gains_and_pose_cover_every_joint(robot):
    assert tuple(joint for joint, _ in robot.gains.kp) == robot.independent
    assert tuple(joint for joint, _ in robot.gains.kd) == robot.independent
    assert {joint for joint, _ in robot.pose.joints} == set(robot.independent)


def test_second_load_is_equal_and_hashes_alike(name):
    first, second = load_robot(name), load_robot(name)
    assert first is not second
    assert first == second
    assert hash(first) == hash(second)
    assert set(NAMES) <= set(robots())


def test_impossible_inertia_is_warned_about_once_unless_it_is_kept_knowingly():
    robot = load_robot("mini_cheetah")
    unknowing = replace(robot, kept_inertia=("H*_hip_link",))
    _warn_of_inertia.cache_clear()
    with pytest.warns(InertiaWarning, match=r"mini_cheetah: the inertia of FR_hip_link, FL_hip_link violates"):
        check_robot(unknowing)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_robot(unknowing)
        _warn_of_inertia.cache_clear()
        check_robot(robot)


def test_no_robot_that_is_shipped_warns():
    _warn_of_inertia.cache_clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in robots():
            load_robot(name)


def test_inertia_that_is_kept_must_be_impossible():
    with pytest.raises(RobotError, match=r"kept_inertia is 'HR_knee_link': expected one of HR_hip_link"):
        check_robot(replace(load_robot("mini_cheetah"), kept_inertia=("HR_knee_link",)))


@pytest.mark.parametrize("inside", [True, False], ids=["wheel", "checkout"])
def test_assets_are_found_in_a_wheel_and_in_a_checkout(tmp_path, inside):
    package = Path(ce_gym.model.__file__).parents[1]
    shutil.copytree(package / "model", tmp_path / "ce_gym" / "model")
    (tmp_path / "ce_gym" / "__init__.py").touch()  # else an installed package would come first
    source = ce_gym.model.assets_folder()
    shutil.copytree(source, tmp_path / "ce_gym" / "assets" if inside else tmp_path / "assets")
    code = "import ce_gym.model as m; print(m.__file__, m.robots(), m.load_robot('mit_humanoid_leg').source)"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    result = subprocess.run(
        [sys.executable, "-P", "-c", code], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert all(name in result.stdout for name in NAMES)
    assert result.stdout.count(str(tmp_path)) == 2
