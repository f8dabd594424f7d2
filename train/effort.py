"""What walking costs: torque, speed and power of the motors, and the cost of transport.

The policy acts in its own environment, whose control step is cut into sub-steps that hold the action, so that the
peaks between two actions are seen. Torques at the joints are taken to the motors through the transmission,
`tau = W^T tau_m`, `omega = W yd` (arXiv:2311.13732), at every level in the same way. Uses public names of ce_gym only,
and no name of a robot or task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import ce_gym
from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.policies import Policy

Array = NDArray[np.float64]

GRAVITY = 9.81
"""For the weight in the cost of transport [m/s^2]."""

TOLERANCE = 0.01
"""Share of its largest torque by which a motor may exceed what it can give before that counts."""


@dataclass(frozen=True)
class Drives:
    """The motors of a robot, or its joints where a robot file names no motors.

    Attributes:
        names: Of the motors' rotors, or of the joints.
        torque: Largest torque [N m], infinite if unknown, shape (n,).
        stall, velocity: Where the torque-speed line begins [N m] and ends [rad/s], infinite if unknown, shape (n,).
        power: Largest mechanical power that torque limit and torque-speed line allow [W], shape (n,).
        speeds: Takes positions (nq, n) to `W`, column by column of the matrix (n_motors, n_joints) below each other.
        constant: `W` if it is the same in every position.
    """

    names: tuple[str, ...]
    torque: Array
    stall: Array
    velocity: Array
    power: Array
    speeds: ca.Function
    constant: Array | None

    @classmethod
    def of(cls, model: ce_gym.Model) -> Drives:
        """The motors of the robot of `model`, whatever the level of that: all have them on the same rotors."""
        robot, exact = model.robot, ce_gym.Model(model.robot, "exact")
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

    def at_motors(self, model: ce_gym.Model, q: Array, yd: Array, tau: Array) -> tuple[Array, Array]:
        """Return torques [N m] and speeds [rad/s] of the motors, each shape (n, n_motors).

        Args:
            model: The robot.
            q: Positions, shape (n, nq).
            yd: Velocities of joints, then of what stretches [rad/s], shape (n, n_joints + n_stretches).
            tau: What the motors do to the joints [N m], shape (n, n_joints).
        """
        (joints, stretched), own = np.split(yd, [tau.shape[1]], axis=1), self.own_speeds(model)
        if self.constant is not None:
            return tau @ np.linalg.pinv(self.constant), joints @ self.constant.T + stretched @ own
        guess = [model.dependent_guess(q).T] if self.speeds.n_in() == 2 else []
        columns = ca.DM(self.speeds(q[:, : self.speeds.size1_in(0)].T, *guess)).full()
        W = columns.reshape(joints.shape[1], len(self.names), len(q)).transpose(2, 1, 0)
        speed = np.einsum("nmj,nj->nm", W, joints) + stretched @ own
        return np.einsum("nj,njm->nm", tau, np.linalg.pinv(W)), speed

    def own_speeds(self, model: ce_gym.Model) -> NDArray[np.bool_]:
        """Return speeds of motors for unit velocities of what stretches, each its own, (n_stretches, n_motors)."""
        rotors = {elastic.stretch: elastic.rotor for elastic in model.robot.elastic}
        turned = [rotors[name] for name in model.robot.independent if name in rotors]
        return np.array(turned, object)[:, None] == np.array(self.names, object)

    def beyond(self, tau: Array, speed: Array, before: Array) -> NDArray[np.bool_]:
        """Return which motors give more than current and voltage allow at any speed of a sub-step, shape (n, n_motors).

        Torques are means over a sub-step, in which an impact may turn a motor round: what it can give at the speed
        at either end is no violation.

        Args:
            tau: Torques [N m], shape (n, n_motors).
            speed: At the end of the sub-step [rad/s], shape (n, n_motors).
            before: At its start, likewise.
        """
        slowest = np.minimum(np.sign(tau) * speed, np.sign(tau) * before)
        allowed = np.clip(self.stall * (1 - slowest / self.velocity), 0, self.torque)
        return np.abs(tau) > allowed + TOLERANCE * self.torque


def largest_power(torque: float, stall: float | None, velocity: float) -> float:
    """Return the largest mechanical power of a motor [W] with `torque * (1 - speed / velocity)` from `stall` as limit.

    On the line alone that is at half the no-load speed; if the current stops the motor there, where line and limit
    meet.
    """
    stall = torque if stall is None else stall
    if not math.isfinite(stall * velocity):
        return math.inf
    speed = max(velocity / 2, velocity * (1 - torque / stall))
    return min(torque, stall * (1 - speed / velocity)) * speed


@dataclass
class Sums:
    """What is added up over all sub-steps of all robots that have not fallen.

    Attributes:
        count: Sub-steps.
        distance: Travelled by the bases over the ground [m].
        torque: Of each motor, sum of magnitudes [N m].
        driving: Of each motor, sum of positive powers [W].
        net: Of each motor, sum of powers, braking negative [W].
        peak_torque: Of each motor [N m].
        peak_power: Of each motor, driving [W].
        beyond: Of each motor, sub-steps in which it gives more than it can.
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
        """Take one sub-step in; torques, speeds and whether a motor gives more than it can (n, n_motors), ways (n,)."""
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
    """Let the policy act on random commands and watch its motors at every sub-step.

    Actions arrive without latency. A robot counts until its first fall.

    Args:
        policy: With its record.
        episodes: Robots.
        seconds: How long they walk.
        seed: Of the first robot.
        **kwargs: Given to the environment.

    Returns:
        cost_of_transport: energy of all motors while they drive, over weight times distance travelled, what they take
        back while braking being lost; cost_of_transport_net: the same with what they take back. seconds: watched, over
        all robots; speed: mean over the ground [m/s]; power: mean of all motors while they drive [W]. mean_torque,
        mean_power, peak_torque, peak_power: shares of the motors' limits, means over motors and the worst motor, whose
        name is in peak_torque_at and peak_power_at; None where limits are unknown, and so is beyond_limits, the share
        of motors' sub-steps in which they give more than they can, see `Drives.beyond`. motors: the same for each motor
        in N m and W. An empty dictionary if the environment does not say how its control step is cut.
    """
    spec = policy.record["policy_spec"]
    if "physics_dt" not in spec:
        return {}
    dt = kwargs.get("dt", spec["physics_dt"])
    hold, history = round(spec["control_dt"] / dt), spec["observation"]["history"]
    kwargs = {k: x for k, x in kwargs.items() if k not in ("critic", "obs_mode")}
    kwargs |= {"n_substeps": 1, "latency": (0, 0), "history": 1, "max_episode_steps": 10**9}
    envs = make_sb3_vec_env(policy.record["env"], episodes, seed, **kwargs)
    try:
        native: Any = envs.envs.unwrapped
        drives = Drives.of(native.model)
        n = len(drives.names)
        sums = Sums(0, 0.0, *(np.zeros(n) for _ in range(6)))
        frame: Any = envs.reset()
        q, v, tau = (native.batch.rows(name) for name in ("q", "v", "torque"))
        _, spun = drives.at_motors(native.model, q, v[:, 6:], tau)
        seen, running = np.tile(frame, history), np.ones(episodes, bool)
        for _ in range(round(seconds / spec["control_dt"])):
            action, _ = policy.predict(seen)
            for _ in range(hold):
                before = native.batch.rows("q")[:, :2]
                frame, _, dones, _ = envs.step(action)
                running &= ~dones
                q, v, tau = (native.batch.rows(name)[running] for name in ("q", "v", "torque"))
                if not len(q):
                    return _result(sums, drives, native.model.total_mass, dt)
                travelled = np.hypot(*(q[:, :2] - before[running]).T)
                torque, speed = drives.at_motors(native.model, q, v[:, 6:], tau)
                sums.add(torque, speed, travelled, drives.beyond(torque, speed, spun[running]))
                spun[running] = speed
            seen = np.hstack([frame, seen[:, : seen.shape[1] - frame.shape[1]]])
        return _result(sums, drives, native.model.total_mass, dt)
    finally:
        envs.close()


def _result(sums: Sums, drives: Drives, mass: float, dt: float) -> dict[str, Any]:
    """Means and shares of what was added up; see `effort`."""
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
