"""Torque, speed and power of the motors, and the cost of transport.

The policy acts in its own environment, which returns after each sub-step, so that peaks between two actions are
measured. The transmission relates joints and motors: `tau = W^T tau_m`, `omega = W yd` (arXiv:2311.13732), in the same
way at every level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.dynamics.model import Model
from ce_gym.learn.evaluation.episodes import UNLIMITED, open_environments, run_policy
from ce_gym.policies import Policy

Array = NDArray[np.float64]

GRAVITY = 9.81
"""Gravity in the cost of transport [m/s^2]."""

TOLERANCE = 0.01
"""Tolerance of the torque limit, as a fraction of the largest torque."""


@dataclass(frozen=True)
class Drives:
    """The motors of a robot, or its joints where a robot file names no motors.

    Attributes:
        names: Names of the motors' rotors, or of the joints.
        torque, stall, velocity: Largest torque [N m], and stall torque [N m] and no-load speed [rad/s] of the
            torque-speed line, infinite if unknown, shape (n_motors,) each.
        power: Largest mechanical power within these limits [W], shape (n_motors,).
        speeds: Function from positions (nq, n) to `W` (n_motors, n_joints), stacked column by column.
        constant: `W` if it does not depend on positions, otherwise None.
    """

    names: tuple[str, ...]
    torque: Array
    stall: Array
    velocity: Array
    power: Array
    speeds: ca.Function
    constant: Array | None

    @classmethod
    def of(cls, model: Model) -> Drives:
        """Return the motors of a model's robot; they are the same at all levels."""
        robot, exact = model.robot, Model(model.robot, "exact")
        limits = [(motor.rotor, motor.torque, motor.stall, motor.velocity) for motor in robot.motors]
        if not limits:
            joints = [(name, robot.body(name).joint) for name in robot.driven]
            limits = [(name, joint.torque, None, joint.velocity) for name, joint in joints]
        names, torques, stalls, velocities = zip(*limits, strict=True)
        stalls = [torque if stall is None else stall for torque, stall in zip(torques, stalls, strict=True)]
        function = exact.casadi_function("spanning")
        symbols = [ca.SX.sym(function.name_in(i), function.size1_in(i)) for i in range(function.n_in())]
        rows = [6 + exact.spanning_names.index(name) for name in names]
        W = ca.densify(ca.jacobian(function.call(symbols)[1][rows], symbols[1])[:, 6:])
        return cls(
            names=names,
            torque=np.array(torques),
            stall=np.array(stalls),
            velocity=np.array(velocities),
            power=np.array([largest_power(*limit) for limit in zip(torques, stalls, velocities, strict=True)]),
            speeds=ca.Function("W", [symbols[0], *symbols[2:]], [ca.vec(W)]),
            constant=None if ca.depends_on(W, symbols[0]) else ca.evalf(W).full(),
        )

    def at_motors(self, model: Model, q: Array, yd: Array, tau: Array) -> tuple[Array, Array]:
        """Return torques [N m] and speeds [rad/s] of the motors, each shape (n, n_motors).

        Args:
            model: Model of the robot.
            q: Positions, shape (n, nq).
            yd: Velocities of joints, then of elastic stretches [rad/s], shape (n, n_joints + n_stretches).
            tau: Torques of the motors at the joints [N m], shape (n, n_joints).
        """
        joints, stretches = np.split(yd, [tau.shape[1]], axis=1)
        rotors = {elastic.stretch: elastic.rotor for elastic in model.robot.elastic}
        stretched = np.array([rotors[name] for name in model.robot.independent if name in rotors], object)
        relative = stretches @ (stretched[:, None] == np.array(self.names, object))
        if self.constant is not None:
            return tau @ np.linalg.pinv(self.constant), joints @ self.constant.T + relative
        guess = [model.dependent_guess(q).T] if self.speeds.n_in() == 2 else []
        columns = ca.DM(self.speeds(q[:, : self.speeds.size1_in(0)].T, *guess)).full()
        W = columns.reshape(joints.shape[1], len(self.names), len(q)).transpose(2, 1, 0)
        return np.einsum("nj,njm->nm", tau, np.linalg.pinv(W)), np.einsum("nmj,nj->nm", W, joints) + relative

    def beyond(self, tau: Array, speed: Array, last_speed: Array) -> NDArray[np.bool_]:
        """Return which motors exceed their torque-speed limits in a sub-step, shape (n, n_motors) as all arguments.

        Torques [N m] are means over a sub-step, in which an impact may reverse a motor. So a torque is allowed if the
        limit at `last_speed` [rad/s], at the start of the sub-step, or at `speed`, at its end, allows it.
        """
        slowest = np.minimum(np.sign(tau) * speed, np.sign(tau) * last_speed)
        allowed = np.clip(self.stall * (1 - slowest / self.velocity), 0, self.torque)
        return np.abs(tau) > allowed + TOLERANCE * self.torque


def largest_power(torque: float, stall: float, velocity: float) -> float:
    """Return the largest mechanical power of a motor [W] with limits as in `Drives`.

    The maximum is at half the no-load speed, or where the line meets the torque limit if that speed is higher.
    """
    if not math.isfinite(stall * velocity):
        return math.inf
    speed = max(velocity / 2, velocity * (1 - torque / stall))
    return min(torque, stall * (1 - speed / velocity)) * speed


def effort(policy: Policy, *, episodes: int = 32, seconds: float = 10.0, seed: int = 0, **kwargs: Any) -> dict:
    """Let a policy act on random commands and measure its motors at every sub-step.

    Actions have no latency. A robot counts until its first fall.

    Args:
        policy: Policy with its record.
        episodes: Number of robots.
        seconds: Duration [s].
        seed: Seed of the first robot.
        **kwargs: Arguments of the environment.

    Returns:
        - cost_of_transport: Positive work of all motors divided by weight times distance.
        - cost_of_transport_net: The same with braking work subtracted.
        - seconds: Measured time of all robots together [s].
        - speed: Mean speed over the ground [m/s].
        - power: Mean positive power of all motors together [W].
        - mean_torque, mean_power: Fractions of the motors' limits, mean over motors.
        - peak_torque, peak_power: The largest fraction of a motor, whose name is peak_torque_at or peak_power_at.
        - beyond_limits: Fraction of sub-steps beyond the limits, see `Drives.beyond`.
        - motors: Torques [N m] and powers [W] of each motor.

        Fractions are None if limits are unknown. The dictionary is empty if the record has no length of sub-steps.
    """
    spec = policy.record["policy_spec"]
    if "physics_dt" not in spec:
        return {}
    dt, control_dt = kwargs.get("dt", spec["physics_dt"]), spec["control_dt"]
    held = HeldActions(policy, round(control_dt / dt), spec["observation"]["history"])
    kwargs = {k: x for k, x in kwargs.items() if k not in ("critic", "obs_mode")}
    kwargs |= {"n_substeps": 1, "latency": (0, 0), "history": 1, "max_episode_steps": UNLIMITED}
    with open_environments(policy.record["env"], episodes, seed, **kwargs) as (envs, obs):
        native: Any = envs.unwrapped
        model, drives = native.model, Drives.of(native.model)
        steps, distance = 0, 0.0
        sums = {name: np.zeros(len(drives.names)) for name in ("torque", "driving", "net", "beyond")}
        peaks = {name: np.zeros(len(drives.names)) for name in ("torque", "power")}
        q, v, tau = (native.batch.rows(name) for name in ("q", "v", "torque"))
        _, last_speed = drives.at_motors(model, q, v[:, 6:], tau)
        running = np.ones(episodes, bool)
        for step in run_policy(held, envs, obs, steps=round(seconds / control_dt) * held.hold, label="motors"):
            running &= ~step.done
            if not running.any():
                break
            last_q, q = q, native.batch.rows("q")
            v, tau = (native.batch.rows(name)[running] for name in ("v", "torque"))
            torque, speed = drives.at_motors(model, q[running], v[:, 6:], tau)
            power = torque * speed
            steps += len(power)
            distance += float(np.hypot(*(q[running, :2] - last_q[running, :2]).T).sum())
            sums["torque"] += np.abs(torque).sum(0)
            sums["driving"] += np.maximum(power, 0).sum(0)
            sums["net"] += power.sum(0)
            sums["beyond"] += drives.beyond(torque, speed, last_speed[running]).sum(0)
            peaks["torque"] = np.maximum(peaks["torque"], np.abs(torque).max(0))
            peaks["power"] = np.maximum(peaks["power"], power.max(0))
            last_speed[running] = speed
    count, weight_distance = max(steps, 1), model.total_mass * GRAVITY * distance
    result: dict[str, Any] = {
        "cost_of_transport": float(sums["driving"].sum() * dt / weight_distance) if distance else None,
        "cost_of_transport_net": float(sums["net"].sum() * dt / weight_distance) if distance else None,
        "seconds": steps * dt,
        "speed": distance / (count * dt),
        "power": float(sums["driving"].sum() / count),
    }
    motors: dict[str, dict[str, Any]] = {name: {} for name in drives.names}
    measured = {
        "torque": (sums["torque"] / count, peaks["torque"], drives.torque),
        "power": (sums["driving"] / count, peaks["power"], drives.power),
    }
    for quantity, (means, highest, limits) in measured.items():
        known, largest = np.isfinite(limits), int((highest / limits).argmax())
        result[f"mean_{quantity}"] = float((means / limits).mean()) if known.all() else None
        result[f"peak_{quantity}"] = float(highest[largest] / limits[largest]) if known.all() else None
        result[f"peak_{quantity}_at"] = drives.names[largest] if known.all() else None
        for i, name in enumerate(drives.names):
            motors[name][f"mean_{quantity}"] = float(means[i])
            motors[name][f"peak_{quantity}"] = float(highest[i])
            motors[name][f"{quantity}_limit"] = float(limits[i]) if known[i] else None
    result["beyond_limits"] = float(sums["beyond"].mean() / count) if np.isfinite(drives.power).all() else None
    return result | {"motors": motors}


class HeldActions:
    """A policy that is called at every sub-step and changes its action after `hold` sub-steps.

    Its observations consist of the last `history` frames, the newest first.
    """

    def __init__(self, policy: Policy, hold: int, history: int) -> None:
        self.policy, self.hold, self.history = policy, hold, history
        self.step, self.observation = 0, np.zeros((0, 0))

    def predict(self, frame: NDArray, /, *, deterministic: bool = True) -> tuple[NDArray, None]:
        """Return the action of the current control step; `frame` (n, size) is the newest part of the observation."""
        if self.step % self.hold == 0:
            earlier = self.observation[:, : -frame.shape[1]] if self.step else np.tile(frame, self.history - 1)
            self.observation = np.hstack([frame, earlier])
            self.action, _ = self.policy.predict(self.observation, deterministic=deterministic)
        self.step += 1
        return self.action, None
