"""What a robot is, where it is read from, and how its bodies cluster."""

from ce_gym.model.checks import check_robot
from ce_gym.model.clusters import Cluster, ClusterTree, cluster_tree
from ce_gym.model.description import (
    IDENTITY,
    ZERO,
    Body,
    Constraint,
    ContactMaterial,
    ContactSphere,
    Gains,
    Inertial,
    Joint,
    LinearConstraint,
    Mat3,
    Motor,
    Placement,
    Pose,
    Robot,
    Shape,
    Vec3,
)
from ce_gym.model.errors import InertiaWarning, RobotError
from ce_gym.model.load import assets_folder, load_robot, robots

__all__ = [
    "IDENTITY",
    "ZERO",
    "Body",
    "Cluster",
    "ClusterTree",
    "Constraint",
    "ContactMaterial",
    "ContactSphere",
    "Gains",
    "InertiaWarning",
    "Inertial",
    "Joint",
    "LinearConstraint",
    "Mat3",
    "Motor",
    "Placement",
    "Pose",
    "Robot",
    "RobotError",
    "Shape",
    "Vec3",
    "assets_folder",
    "check_robot",
    "cluster_tree",
    "load_robot",
    "robots",
]
