"""Torque, speed and power of the motors, and the cost of transport.

The policy acts in its own environment, which returns after each sub-step, so that peaks between two actions are
measured. The transmission relates joints and motors: `tau = W^T tau_m`, `omega = W yd` (arXiv:2311.13732), in the same
way at every level.
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.dynamics.model import Model
from ce_gym.learn.evaluate.episodes import run_policy
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
        torque: Largest torque [N m], infinite if unknown, shape (n,).
        stall, velocity: Stall torque [N m] and no-load speed [rad/s] of the torque-speed line, infinite if unknown,
            shape (n,).
        power: Largest mechanical power within torque limit and torque-speed line [W], shape (n,).
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
        names = tuple(name for name, *_ in limits)
        function = exact.casadi_function("spanning")
        symbols = [ca.SX.sym(function.name_in(i), function.size1_in(i)) for i in range(function.n_in())]
        spun = function.call(symbols)[1]
        rows = [6 + exact.spanning_names.index(name) for name in names]
        W = ca.densify(ca.jacobian(spun[rows], symbols[1])[:, 6:])
        same = not ca.depends_on(W, symbols[0])
        return cls(
            names=names,
            torque=np.array([torque for _, torque, _, _ in limits]),
            stall=np.array([torque if stall is None else stall for _, torque, stall, _ in limits]),
            velocity=np.array([speed for *_, speed in limits]),
            power=np.array([largest_power(torque, stall, speed) for _, torque, stall, speed in limits]),
            speeds=ca.Function("W", [symbols[0], *symbols[2:]], [ca.vec(W)]),
            constant=ca.evalf(W).full() if same else None,
        )

    def at_motors(self, model: Model, q: Array, yd: Array, tau: Array) -> tuple[Array, Array]:
        """Return torques [N m] and speeds [rad/s] of the motors, each shape (n, n_motors).

        Args:
            model: Model of the robot.
            q: Positions, shape (n, nq).
            yd: Velocities of joints, then of elastic stretches [rad/s], shape (n, n_joints + n_stretches).
            tau: Torques of the motors at the joints [N m], shape (n, n_joints).
        """
        (joints, stretched), own = np.split(yd, [tau.shape[1]], axis=1), self.own_speeds(model)
        if self.constant is not None:
            return tau @ np.linalg.pinv(self.constant), joints @ self.constant.T + stretched @ own
        guess = [model.dependent_guess(q).T] if self.speeds.n_in() == 2 else []
        columns = ca.DM(self.speeds(q[:, : self.speeds.size1_in(0)].T, *guess)).full()
        W = columns.reshape(joints.shape[1], len(self.names), len(q)).transpose(2, 1, 0)
        speed = np.einsum("nmj,nj->nm", W, joints) + stretched @ own
        return np.einsum("nj,njm->nm", tau, np.linalg.pinv(W)), speed

    def own_speeds(self, model: Model) -> NDArray[np.bool_]:
        """Return which motor each elastic stretch belongs to, shape (n_stretches, n_motors)."""
        rotors = {elastic.stretch: elastic.rotor for elastic in model.robot.elastic}
        turned = [rotors[name] for name in model.robot.independent if name in rotors]
        return np.array(turned, object)[:, None] == np.array(self.names, object)

    def beyond(self, tau: Array, speed: Array, last_speed: Array) -> NDArray[np.bool_]:
        """Return which motors exceed their torque-speed limits in a sub-step, shape (n, n_motors).

        Torques are means over a sub-step, in which an impact may reverse a motor. So a torque is allowed if the limit
        at the start or at the end of the sub-step allows it.

        Args:
            tau: Torques [N m], shape (n, n_motors).
            speed: Speeds at the end of the sub-step [rad/s], shape (n, n_motors).
            last_speed: Speeds at the start of the sub-step [rad/s], shape (n, n_motors).
        """
        slowest = np.minimum(np.sign(tau) * speed, np.sign(tau) * last_speed)
        allowed = np.clip(self.stall * (1 - slowest / self.velocity), 0, self.torque)
        return np.abs(tau) > allowed + TOLERANCE * self.torque


def largest_power(torque: float, stall: float | None, velocity: float) -> float:
    """Return the largest mechanical power of a motor [W] with torque limit and torque-speed line.

    The maximum is at half the no-load speed, or where the line meets the torque limit if that speed is higher.

    Args:
        torque: Torque limit [N m].
        stall: Stall torque of the line [N m]; the torque limit if None.
        velocity: No-load speed of the line [rad/s].
    """
    stall = torque if stall is None else stall
    if not math.isfinite(stall * velocity):
        return math.inf
    speed = max(velocity / 2, velocity * (1 - torque / stall))
    return min(torque, stall * (1 - speed / velocity)) * speed


@dataclass
class Sums:
    """Sums over all sub-steps of all robots that have not fallen; arrays have one entry per motor.

    Attributes:
        count: Number of sub-steps.
        distance: Horizontal distance travelled by the bases [m].
        torque: Sum of torque magnitudes [N m].
        driving: Sum of positive powers [W].
        net: Sum of all powers, negative when braking [W].
        peak_torque: Largest torque magnitude [N m].
        peak_power: Largest positive power [W].
        beyond: Number of sub-steps beyond the torque-speed limits.
    """

    count: int
    distance: float
    torque: Array
    driving: Array
    net: Array
    peak_torque: Array
    peak_power: Array
    beyond: Array

    def add(self, tau: Array, speed: Array, travelled: Array, beyond: NDArray[np.bool_]) -> None:
        """Add one sub-step: torques, speeds and violations of limits (n, n_motors), and distances (n,)."""
        power = tau * speed
        self.count += len(tau)
        self.distance += float(travelled.sum())
        self.torque += np.abs(tau).sum(0)
        self.driving += np.maximum(power, 0).sum(0)
        self.net += power.sum(0)
        self.peak_torque = np.maximum(self.peak_torque, np.abs(tau).max(0, initial=0.0))
        self.peak_power = np.maximum(self.peak_power, power.max(0, initial=0.0))
        self.beyond += beyond.sum(0)


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
    kwargs |= {"n_substeps": 1, "latency": (0, 0), "history": 1, "max_episode_steps": 10**9}
    with closing(make_sb3_vec_env(policy.record["env"], episodes, seed, **kwargs)) as envs:
        native: Any = envs.envs.unwrapped
        model, drives = native.model, Drives.of(native.model)
        sums = Sums(0, 0.0, *(np.zeros(len(drives.names)) for _ in range(6)))
        obs: Any = envs.reset()
        q, v, tau = (native.batch.rows(name) for name in ("q", "v", "torque"))
        _, last_speed = drives.at_motors(model, q, v[:, 6:], tau)
        running = np.ones(episodes, bool)
        for dones, _ in run_policy(held, envs, obs, steps=round(seconds / control_dt) * held.hold):
            running &= ~dones
            if not running.any():
                break
            last_q, q = q, native.batch.rows("q")
            v, tau = (native.batch.rows(name)[running] for name in ("v", "torque"))
            travelled = np.hypot(*(q[running, :2] - last_q[running, :2]).T)
            torque, speed = drives.at_motors(model, q[running], v[:, 6:], tau)
            sums.add(torque, speed, travelled, drives.beyond(torque, speed, last_speed[running]))
            last_speed[running] = speed
        return _result(sums, drives, model.total_mass, dt)


class HeldActions:
    """A policy that is called at every sub-step and changes its action at every control step.

    Args:
        policy: The policy.
        hold: Sub-steps in a control step.
        history: Number of frames in an observation of the policy.
    """

    def __init__(self, policy: Policy, hold: int, history: int) -> None:
        self.policy, self.hold, self.history = policy, hold, history
        self.step = 0

    def predict(self, frame: NDArray, /, *, deterministic: bool = True) -> tuple[NDArray, None]:
        """Return the action of the current control step; `frame` (n, size) is the newest part of the observation."""
        if self.step == 0:
            self.observation = np.tile(frame, self.history)
        elif self.step % self.hold == 0:
            self.observation = np.hstack([frame, self.observation[:, : -frame.shape[1]]])
        if self.step % self.hold == 0:
            self.action, _ = self.policy.predict(self.observation, deterministic=deterministic)
        self.step += 1
        return self.action, None


def _result(sums: Sums, drives: Drives, mass: float, dt: float) -> dict[str, Any]:
    """Return means and fractions of limits from the sums; see `effort`."""
    count, weight_distance = max(sums.count, 1), mass * GRAVITY * sums.distance
    per_motor = {
        "mean_torque": sums.torque / count,
        "mean_power": sums.driving / count,
        "peak_torque": sums.peak_torque,
        "peak_power": sums.peak_power,
    }
    limits = {"torque": drives.torque, "power": drives.power}
    shares = {name: values / limits[name.split("_")[1]] for name, values in per_motor.items()}
    known = {name: bool(np.isfinite(limits[name.split("_")[1]]).all()) for name in shares}
    result: dict[str, Any] = {
        "cost_of_transport": float(sums.driving.sum() * dt / weight_distance) if weight_distance else None,
        "cost_of_transport_net": float(sums.net.sum() * dt / weight_distance) if weight_distance else None,
        "seconds": sums.count * dt,
        "speed": sums.distance / (count * dt),
        "power": float(sums.driving.sum() / count),
    }
    for name, share in shares.items():
        peak = name.startswith("peak")
        result[name] = (float(share.max()) if peak else float(share.mean())) if known[name] else None
        if peak:
            result[f"{name}_at"] = drives.names[int(share.argmax())] if known[name] else None
    result["beyond_limits"] = float(sums.beyond.mean() / count) if known["peak_power"] else None
    result["motors"] = {
        name: {key: float(values[i]) for key, values in per_motor.items()}
        | {f"{key}_limit": float(x[i]) if np.isfinite(x[i]) else None for key, x in limits.items()}
        for i, name in enumerate(drives.names)
    }
    return result
