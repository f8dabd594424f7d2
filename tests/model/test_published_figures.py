"""The robots that come with the package carry the published figures."""

import numpy as np
import pytest
from published import read_facts, rotation

from ce_gym.model import Robot, cluster_tree, load_robot


@pytest.fixture(scope="module", params=["mini_cheetah", "mit_humanoid_leg", "mit_humanoid", "jvrc1"])
def robot(request) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="module")
def facts(robot) -> dict:
    return read_facts(robot.name)


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
    assert set(facts["limits"]["joints"]) == set(robot.independent)
    for link, limits in facts["limits"]["joints"].items():
        joint = robot.body(link).joint
        assert joint.position == tuple(limits["position"])
        assert joint.velocity == limits["velocity"]
        assert joint.torque == pytest.approx(limits["torque"], abs=0.011)  # 27.99 = 3 N m * 9.33 is published as 28


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


def test_gains_and_pose_cover_every_joint(robot):
    assert tuple(joint for joint, _ in robot.gains.kp) == robot.independent
    assert tuple(joint for joint, _ in robot.gains.kd) == robot.independent
    assert {joint for joint, _ in robot.pose.joints} == set(robot.independent)
    for joint, angle in robot.pose.joints:
        low, high = robot.body(joint).joint.position
        assert low <= angle <= high
