"""The cost of transport of legs that run as prescribed, by inverse dynamics, for every gear ratio and rotor."""

from __future__ import annotations

import numpy as np

from ce_gym.bench.exactness.legs.signals import series_of, stride
from ce_gym.bench.exactness.mechanisms import leg_on_stand
from ce_gym.bench.exactness.protocol import FEET, K2, K2_INERTIA, PROGRAMS, Array, Leg
from ce_gym.bench.exactness.scaling import scaled
from ce_gym.dynamics.model import Model
from ce_gym.model import load_robot
from ce_gym.model.mechanism import LEVELS

SAMPLES = 200
"""Of a stride."""


class Gait:
    """A robot that runs as prescribed: its base does not accelerate, the ground carries its weight.

    Args:
        name: Of the robot.

    Attributes:
        torques: Of the joints at each level, shape (n_samples, n_joints) [N m].
        rates: Speed of each motor for unit speeds of the joints, shape (n_samples, n_motors, n_joints).
        speeds: Of the motors, shape (n_samples, n_motors) [rad/s].
        carried: What the ground's forces give to the joints, shape (n_samples, n_joints) [N m].
    """

    def __init__(self, name: str) -> None:
        robot, self.program = load_robot(name), PROGRAMS[name]
        models = {level: Model(robot, level) for level in LEVELS}
        exact = self._model = models["exact"]
        self.phase = np.arange(SAMPLES) / SAMPLES
        q, v, vdot = self._motion(name)
        self.torques = {level: model.inverse_dynamics(q, v, vdot)[:, 6:] for level, model in models.items()}
        self.rates = exact.actuator_matrix(q)[..., 6:]
        self.speeds = np.einsum("tmj,tj->tm", self.rates, v[:, 6:])
        rotors = [robot.body(motor.rotor) for motor in robot.motors]
        inertia = [np.array(r.joint.axis) @ np.array(r.inertial.inertia) @ np.array(r.joint.axis) for r in rotors]
        self.k2 = K2 * np.array(inertia) / K2_INERTIA

    def cost(self, level: str, ratio: Array, inertia: Array) -> Array:
        """Return the cost of transport [-] of designs, shape of `ratio` and `inertia`, with the torques of a level."""
        r, s = (np.asarray(x)[..., None, None] for x in (ratio, inertia))
        tau = scaled(level, self.torques, r, s) - self.carried
        motor = np.linalg.solve(np.swapaxes(self.rates, -1, -2), tau[..., None])[..., 0]  # tau = W^T motor, at ratio 1
        power = np.maximum(motor * self.speeds, 0) + (motor / r) ** 2 / (s * self.k2)
        weight = 9.81 * self._model.total_mass
        return power.sum(-1).mean(-1) / (weight * self.program.speed)

    def _motion(self, name: str) -> tuple[Array, Array, Array]:
        """Return positions, velocities and accelerations of a stride, shape (n_samples, nq or nv); sets `carried`."""
        model, program = self._model, self.program
        q = np.tile(model.standing_q, (SAMPLES, 1))
        v, vdot = np.zeros((SAMPLES, model.nv)), np.zeros((SAMPLES, model.nv))
        v[:, 3] = program.speed
        q[:, 7:] *= program.gait
        late = []
        for (body, point), (root, phase) in zip(FEET[name].items(), program.legs, strict=True):
            leg = Leg(name, root, body, point, program.speed, program.frequency)
            limb = Model(leg_on_stand(leg))
            parts = series_of(stride(limb, leg, program.gait * limb.standing_q[None]), leg.frequency,
                              (self.phase - phase) / leg.frequency)  # fmt: skip
            columns = [6 + model.joint_links.index(joint) for joint in limb.joint_links]
            q[:, [c + 1 for c in columns]], v[:, columns], vdot[:, columns] = (x[:, 0] for x in parts)
            late.append(phase)
        self.carried = self._ground(model, name, q, np.array(late))
        return q, v, vdot

    def _ground(self, model: Model, name: str, q: Array, late: Array) -> Array:
        """Return what a half cosine of force, vertical, at the foot's lowest point gives to the joints."""
        share = np.maximum(np.cos(2 * np.pi * (self.phase[:, None] - late)), 0.0)
        force = np.pi * 9.81 * model.total_mass / len(late) * share
        bodies = [model.body_names.index(body) for body in FEET[name]]
        unit = np.broadcast_to(np.eye(model.nv), (SAMPLES, model.nv, model.nv))
        angular, linear = model.body_velocities(np.broadcast_to(q[:, None], (SAMPLES, model.nv, q.shape[1])), unit)
        _, rotations = model.body_poses(q)
        places = np.einsum("tbij,bj->tbi", rotations[:, bodies], np.array(list(FEET[name].values())))
        rises = linear[:, :, bodies] + np.cross(angular[:, :, bodies], places[:, None])
        return np.einsum("tjb,tb->tj", rises[..., 2], force)[:, 6:]
