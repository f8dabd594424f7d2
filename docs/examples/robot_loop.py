"""Run a policy on a robot with numpy alone: `python -m ce_gym export POLICY --out walk.npz` writes its file."""

import json
import time

import numpy as np

ACTIVATIONS = {
    "Tanh": np.tanh,
    "ReLU": lambda x: np.maximum(x, 0),
    "ELU": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


class PolicyLoop:
    """Joint targets from measurements, both in the robot's order of joints; `counts` has the violations of limits."""

    def __init__(self, file, joint_names):
        data = np.load(file)
        record = json.loads(str(data["record"]))
        self.spec, self.activate = record["policy_spec"], ACTIVATIONS[record["activation"]]
        n_layers = sum(key.startswith("weight") for key in data)
        self.layers = [(data[f"weight_{i}"], data[f"bias_{i}"]) for i in range(n_layers)]
        self.normalisation = data.get("normalisation")
        if self.spec["action"]["kind"] != "joint_pd":
            raise ValueError(f"actions are {self.spec['action']['kind']!r}; expected joint targets, 'joint_pd'")
        if missing := set(self.spec["joints"]) - set(joint_names):
            raise ValueError(f"the robot lacks the joints {sorted(missing)}; expected these names among {joint_names}")
        self.n_joints = len(joint_names)
        self.order = [list(joint_names).index(name) for name in self.spec["joints"]]
        self.kp, self.kd, self.pose = (np.array(self.spec[key]) for key in ("kp", "kd", "default_pose"))
        self.limits = np.array([np.inf if x is None else x for x in self.spec["torque_limits"]])
        self.moved = [self.spec["joints"].index(name) for name in self.spec["action"]["joints"]]
        self.action, self.history, self.stamp, self.steps = np.zeros(len(self.moved)), None, None, 0
        self.counts = dict.fromkeys(("late", "rate", "clipped", "saturated"), 0)

    def step(self, stamp, quaternion, gyro, positions, velocities, command, now=None):
        """Return joint targets [rad] for a measurement at time `stamp` [s]; quaternion (w, x, y, z), body to world."""
        spec, dt = self.spec, self.spec["control_dt"]
        positions, velocities = np.asarray(positions)[self.order], np.asarray(velocities)[self.order]
        self.counts["late"] += (time.monotonic() if now is None else now) - stamp > spec["latency"][1] + 0.1 * dt
        self.counts["rate"] += self.stamp is not None and abs(stamp - self.stamp - dt) > 0.1 * dt
        w, x, y, z = quaternion
        phase = 2 * np.pi * self.steps * dt / spec["gait_period"]
        sources = {
            "q": np.concatenate([np.full(3, np.nan), quaternion, positions]),
            "v": np.concatenate([gyro, np.full(3, np.nan), velocities]),  # the base's velocity is not measured
            "command": np.clip(command, *np.transpose(spec["command"]["range"])),
            "action": self.action,
            "gravity": -np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]),
            "gait": np.array([np.sin(phase), np.cos(phase)]),
        }
        blocks = spec["observation"]["blocks"]
        frame = np.concatenate([b["offset"] + np.array(b["scale"]) * sources[b["of"]][b["rows"]] for b in blocks])
        if not np.isfinite(frame).all():
            raise ValueError("the observation has a number that is not measured; expected a deployable policy")
        frame = np.clip(frame, -spec["normalisation"]["clip"], spec["normalisation"]["clip"]).astype(np.float32)
        older = np.tile(frame, spec["observation"]["history"]) if self.history is None else self.history
        self.history = out = np.concatenate([frame, older[: len(older) - len(frame)]])
        if self.normalisation is not None:
            mean, std, bound = self.normalisation
            out = np.clip((out - mean) / std, -bound, bound)
        for i, (weight, bias) in enumerate(self.layers):
            out = weight @ (self.activate(out) if i else out) + bias
        self.action, self.stamp, self.steps = np.clip(out, -1, 1), stamp, self.steps + 1
        target = self.pose.copy()
        target[self.moved] += np.array(spec["action"]["scale"]) * self.action
        torque = self.kp * (target - positions) - self.kd * velocities
        self.counts["clipped"] += int((np.abs(self.action) == 1).any())
        self.counts["saturated"] += int((np.abs(torque) > self.limits).any())
        targets = np.full(self.n_joints, np.nan)  # for joints that the policy does not know
        targets[self.order] = target
        return targets
