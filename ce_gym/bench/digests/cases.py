"""Cases of `digests`: models, simulators and environments with seeded inputs, by public names of the package only.

Inputs come from `Generator.random` by single additions and multiplications, rounded to single precision, so that every
machine computes the same inputs.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import ce_gym
from ce_gym.model.mechanism import LEVELS

DTYPES = ("float64", "float32")
NUM_ENVS = 17
"""Robots in a batch, not a multiple of the vector width."""
SUBSTEPS = 20
CONTROL_STEPS = 30
EPISODE = 20
"""Time limit of an episode [control steps], so that every environment is also reset."""
OUTPUTS = ("torque", "power", "contact_forces", "energy")
QUICK_ENVIRONMENT = "ce_gym/MiniCheetahVelocity-v0"

SIMULATOR_VARIATIONS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "mini_cheetah": {
        "extrapolated": {"method": "extrapolated"},
        "rk4": {"method": "rk4", "contacts": (), "dt": 0.001},
        "rk8": {"method": "rk8", "contacts": (), "dt": 0.001},
        "limited": {"motors": "limited"},
        "secant": {"friction": "secant"},
        "torque": {"control": "torque"},
        "motor_position": {"control": "motor_position"},
        "motor_torque": {"control": "motor_torque"},
        "terrain": {"terrain": True},
        "parameters": {"parameters": ("friction", "stiffness", "kp", "kd", "rotor_inertia", "ratio", "gravity")},
        "retry": {"retry": 2, "dt": 0.02},
    },
    "tello": {
        "extrapolated": {"method": "extrapolated"},
        "limited": {"motors": "limited"},
        "motor_position": {"control": "motor_position"},
    },
    "six_bar": {"extrapolated": {"method": "extrapolated"}, "rk4": {"method": "rk4"}},
}
"""Additional arguments of `Simulator` by robot and name, at the exact level; `terrain` means rough ground."""

PARAMETERS = {"friction": [0.7], "ratio": [1.0], "rotor_inertia": [1.0]}
"""Parameters that differ between robots, by up to 0.2."""

ENVIRONMENT_VARIATIONS: Mapping[str, Mapping[str, Any]] = {
    "randomised": {
        "randomise": {"friction": (0.5, 1.1), "added_mass": (-0.5, 1.0), "motor_strength": (0.9, 1.1)},
        "noise": {"joint_positions": 0.01, "base_angular_velocity": 0.05},
        "history": 3,
        "latency": (0, 3),
        "push_period": 0.2,
        "heading": True,
        "obs_mode": "dict",
        "critic": ("parameters", "contact_forces", "rotor_speeds"),
    },
    "terrain": {"terrain": {"kind": "stairs", "rise": 0.08}, "command_curriculum": 0.3},
    "motor_pd": {"actions": "motor_pd", "motors": "limited"},
}
"""Additional arguments of the velocity environment of Mini Cheetah, by name."""

Arrays = dict[str, NDArray]


@dataclass(frozen=True)
class Case:
    """One row of the record.

    Attributes:
        kind: "model", "simulator" or "environment".
        name: Name of the robot, or id of the environment.
        level: Transmission level.
        dtype: "float64" or "float32".
        variation: Name of the variation; "" for the defaults.
        arguments: Additional arguments of the simulator or the environment.
    """

    kind: str
    name: str
    level: str
    dtype: str = "float64"
    variation: str = ""
    arguments: Mapping[str, Any] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Return all attributes except the arguments in one line."""
        return " ".join((self.kind, self.name, self.level, self.dtype, self.variation)).rstrip()

    def arrays(self) -> Arrays:
        """Compute the recorded arrays by name."""
        return KINDS[self.kind](self)


def cases(robots: Collection[str], kinds: Collection[str], quick: bool) -> list[Case]:
    """Return the cases of some robots.

    Args:
        robots: Names of robots.
        kinds: Some of "model", "simulator" and "environment".
        quick: Whether to use only the exact level, one environment, and one variation of each kind in one precision.
    """
    everything = [*_models(robots), *_simulators(robots), *_environments(robots)]
    return [case for case in everything if case.kind in kinds and (not quick or _is_quick(case))]


def _is_quick(case: Case) -> bool:
    if case.kind == "environment":
        quick = case.name == QUICK_ENVIRONMENT and case.dtype == "float64" and case.variation in ("", "randomised")
        return quick and case.level == "exact"
    plain = not case.variation
    return case.level == "exact" and (plain or (case.name == "mini_cheetah" and case.variation == "extrapolated"))


def _models(robots: Collection[str]) -> Iterator[Case]:
    return (Case("model", robot, level) for robot in robots for level in LEVELS)


def _simulators(robots: Collection[str]) -> Iterator[Case]:
    for robot in robots:
        for dtype in DTYPES:
            for level in LEVELS:
                yield Case("simulator", robot, level, dtype)
            for variation, arguments in SIMULATOR_VARIATIONS.get(robot, {}).items():
                yield Case("simulator", robot, "exact", dtype, variation, arguments)


def _environments(robots: Collection[str]) -> Iterator[Case]:
    for name, made_of in ce_gym.environment_ids().items():
        robot, task = made_of["robot"], made_of["task"]
        if robot not in robots or made_of["transmission"] != "exact":
            continue
        for level in LEVELS if task == "velocity" else ():
            for dtype in DTYPES:
                yield Case("environment", name, level, dtype)
                yield Case("environment", name, level, dtype, "airborne", {"contacts": ()})
        if robot != "mini_cheetah":
            continue
        if task != "velocity":
            yield Case("environment", name, "exact")
            continue
        for variation, arguments in ENVIRONMENT_VARIATIONS.items():
            yield Case("environment", name, "exact", "float64", variation, arguments)


def _around(rng: np.random.Generator, centre: Any, width: float, *shape: int) -> NDArray:
    """Return single-precision numbers within `width` of `centre`, shape (*shape, *centre.shape)."""
    centre = np.asarray(centre, dtype=float)
    return (centre + (rng.random((*shape, *centre.shape)) * 2 - 1) * width).astype(np.float32).astype(float)


def _states(model: ce_gym.Model, rng: np.random.Generator, n: int, width: float, speed: float) -> tuple[Any, Any]:
    """Return `n` states near the standing pose; floating bases are level and up to 1 cm above the ground."""
    q = np.tile(model.standing_q, (n, 1))
    joints = len(model.joint_links)
    q[:, -joints:] = _around(rng, model.standing_q[-joints:], width, n)
    if model.robot.floating:
        q[:, 2] += _around(rng, 0.005, 0.005, n)
    return q, _around(rng, np.zeros(model.nv), speed, n)


def _model(case: Case) -> Arrays:
    model, rng = ce_gym.Model(case.name, case.level), np.random.default_rng(1)
    q, v = _states(model, rng, 5, 0.1, 2.0)
    if model.robot.floating:
        q[:, 3:7] = (0.5, -0.5, 0.5, 0.5)
    tau, vdot = _around(rng, np.zeros(model.nv), 5.0, 5), _around(rng, np.zeros(model.nv), 10.0, 5)
    return {
        "forward_dynamics": model.forward_dynamics(q, v, tau),
        "inverse_dynamics": model.inverse_dynamics(q, v, vdot),
        "mass_matrix": model.mass_matrix(q),
    }


def _simulator(case: Case) -> Arrays:
    rng, arguments = np.random.default_rng(2), dict(case.arguments)
    if "terrain" in arguments:
        arguments["terrain"] = ce_gym.Terrain(_around(rng, np.zeros((20, 20)), 0.02), cell=0.1, origin=(-1.0, -1.0))
    model = ce_gym.Model(case.name, case.level)
    outputs = (*OUTPUTS, "motor_speed") if model.robot.motors else OUTPUTS
    sim = ce_gym.Simulator(model, NUM_ENVS, dtype=case.dtype, outputs=outputs, **arguments)
    for name, value in PARAMETERS.items() if "parameters" in arguments else ():
        sim.set_parameter(name, _around(rng, value, 0.2, NUM_ENVS))
    q, v = _states(model, rng, NUM_ENVS, 0.0, 0.5)
    sim.set_state(q, v)
    centre, width = _target(sim)
    steps: list[Arrays] = []
    for _ in range(SUBSTEPS):
        sim.step(_around(rng, centre, width, NUM_ENVS))
        steps.append({name: np.asarray(getattr(sim, name)) for name in ("q", "v", "diverged", *outputs)})
    return _stacked(steps)


def _target(sim: ce_gym.Simulator) -> tuple[NDArray, float]:
    """Return centre and half width of the targets [rad or N m]."""
    control, model = sim.options.control, sim.model
    if control.endswith("torque"):
        return np.zeros(len(sim.target_names)), 1.0 if control.startswith("motor") else 5.0
    if control == "position":
        return model.standing_q[-len(model.joint_links) :], 0.3
    standing = model.spanning(model.standing_q, np.zeros(model.nv))[0][-len(model.spanning_names) :]
    return standing[[model.spanning_names.index(name) for name in sim.target_names]], 1.0


def _environment(case: Case) -> Arrays:
    rng = np.random.default_rng(3)
    arguments = {"transmission": case.level, "dtype": case.dtype, "max_episode_steps": EPISODE, **case.arguments}
    envs = gymnasium.make_vec(case.name, num_envs=NUM_ENVS, **arguments)
    steps = [_named(envs.reset(seed=7)[0])]
    for _ in range(CONTROL_STEPS):
        shape = envs.action_space.shape or ()
        observation, *outcome, _ = envs.step(_around(rng, np.zeros(shape), 1.0).astype(np.float32))
        names = ("reward", "terminated", "truncated")
        steps.append(_named(observation) | dict(zip(names, outcome, strict=True)))
    envs.close()
    return _stacked(steps[1:]) | {f"first_{name}": value for name, value in steps[0].items()}


def _named(observation: Any) -> Arrays:
    parts = observation if isinstance(observation, dict) else {"observation": observation}
    return {name: np.array(part) for name, part in parts.items()}


def _stacked(steps: list[Arrays]) -> Arrays:
    """Return the arrays of all steps by name, shape (steps, ...)."""
    return {name: np.stack([step[name] for step in steps]) for name in steps[0]}


KINDS = {"model": _model, "simulator": _simulator, "environment": _environment}
"""Functions that compute the arrays of a case, by kind."""
