"""Gymnasium environments for legged robots whose physics keeps rotors, gears and belts.

    import gymnasium, ce_gym
    gymnasium.register_envs(ce_gym)
    env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0")

`load_robot` reads a robot, `Model` is its dynamics at a transmission level, `Simulator` steps thousands of copies,
`StepDerivatives` differentiates their steps, `Terrain` is ground for it that is not flat.
"""

from ce_gym.compile.system import usable_cores
from ce_gym.diagnostics.scene import scene_report
from ce_gym.dynamics.forces.scene import SceneOptions
from ce_gym.dynamics.model import Model
from ce_gym.envs.custom import register_robot, register_task
from ce_gym.envs.registration import environment_ids, register_environments
from ce_gym.envs.rendering import use_renderers
from ce_gym.envs.terms.registry import metric, observation, reward, termination
from ce_gym.model import InertiaWarning, LossyImportWarning, Robot, RobotError, load_robot, robots
from ce_gym.model.mechanism import LEVELS
from ce_gym.plugins import PluginWarning, load_plugins
from ce_gym.policies import LevelWarning, Policy, PolicyError, load_policy, shipped_policies
from ce_gym.sim.derivatives import StepDerivatives
from ce_gym.sim.simulator import Simulator
from ce_gym.sim.terrain import Terrain

__version__ = "0.1.0"

__all__ = [
    "LEVELS",
    "InertiaWarning",
    "LevelWarning",
    "LossyImportWarning",
    "Model",
    "PluginWarning",
    "Policy",
    "PolicyError",
    "Robot",
    "RobotError",
    "SceneOptions",
    "Simulator",
    "StepDerivatives",
    "Terrain",
    "environment_ids",
    "load_policy",
    "load_robot",
    "metric",
    "observation",
    "register_robot",
    "register_task",
    "reward",
    "robots",
    "scene_report",
    "shipped_policies",
    "termination",
    "usable_cores",
]

register_environments()
use_renderers("ce_gym.viewer.renderers")
load_plugins()
