"""Trained policies: find them by name, read them without running code from files, run them with numpy."""

from ce_gym.model.errors import listed_names
from ce_gym.policies.actor import ACTIVATIONS, Actor, Policy
from ce_gym.policies.arguments import add_env_arg, add_env_arguments, checked_arguments, parse_yaml
from ce_gym.policies.environments import environment_of, import_module_of, registered, warn_of_other_robot
from ce_gym.policies.errors import LevelWarning, PolicyError, RobotWarning
from ce_gym.policies.exports import export_policy
from ce_gym.policies.files import load_policy, read_actor, write_npz
from ce_gym.policies.height_maps import keep_map, with_map
from ce_gym.policies.places import WHERE, find_policy, locate_policy, policy_name, shelf, shipped_policies
from ce_gym.policies.records import RECORD_KEY, environment_record
from ce_gym.policies.robot_data import observation_in_words
from ce_gym.policies.saving import save
from ce_gym.policies.weights import read_weights

__all__ = [
    "ACTIVATIONS",
    "RECORD_KEY",
    "WHERE",
    "Actor",
    "LevelWarning",
    "Policy",
    "PolicyError",
    "RobotWarning",
    "add_env_arg",
    "add_env_arguments",
    "checked_arguments",
    "environment_of",
    "environment_record",
    "export_policy",
    "find_policy",
    "import_module_of",
    "keep_map",
    "listed_names",
    "load_policy",
    "locate_policy",
    "observation_in_words",
    "parse_yaml",
    "policy_name",
    "read_actor",
    "read_weights",
    "registered",
    "save",
    "shelf",
    "shipped_policies",
    "warn_of_other_robot",
    "with_map",
    "write_npz",
]
