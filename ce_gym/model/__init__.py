"""Descriptions of robots, their file formats and their clusters of bodies."""

from ce_gym.model.assets import assets_folder, robots
from ce_gym.model.checks.robot import check_robot
from ce_gym.model.clusters import Cluster, ClusterTree, cluster_tree
from ce_gym.model.constraints import (
    Constraint,
    FunctionConstraint,
    LinearConstraint,
    LoopConstraint,
    PolynomialConstraint,
    RodConstraint,
    constraint_function,
    register_constraint,
)
from ce_gym.model.coordinates import Layout
from ce_gym.model.description import (
    Body,
    Capsule,
    ContactMaterial,
    ContactSphere,
    Frame,
    Gains,
    Inertial,
    Joint,
    Pose,
    Robot,
    Shape,
)
from ce_gym.model.drives import Battery, DriveFriction, Elasticity, Heat, Motor
from ce_gym.model.errors import InertiaWarning, LossyImportWarning, RobotError
from ce_gym.model.formats.hinges import coincident_hinges
from ce_gym.model.frames import IDENTITY, ZERO, Mat3, Placement, Vec3
from ce_gym.model.load import load_robot

__all__ = [
    "IDENTITY",
    "ZERO",
    "Battery",
    "Body",
    "Capsule",
    "Cluster",
    "ClusterTree",
    "Constraint",
    "ContactMaterial",
    "ContactSphere",
    "DriveFriction",
    "Elasticity",
    "Frame",
    "FunctionConstraint",
    "Gains",
    "Heat",
    "InertiaWarning",
    "Inertial",
    "Joint",
    "Layout",
    "LinearConstraint",
    "LoopConstraint",
    "LossyImportWarning",
    "Mat3",
    "Motor",
    "Placement",
    "PolynomialConstraint",
    "Pose",
    "Robot",
    "RobotError",
    "RodConstraint",
    "Shape",
    "Vec3",
    "assets_folder",
    "check_robot",
    "cluster_tree",
    "coincident_hinges",
    "constraint_function",
    "load_robot",
    "register_constraint",
    "robots",
]
