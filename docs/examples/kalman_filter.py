"""Kalman filter: orientation and velocity of 256 robots from gyroscope, accelerometer and legs."""

import numba
import numpy as np

import ce_gym
import ce_gym.numba

GYROSCOPE, ACCELEROMETER = 0.01, 0.2  # standard deviations of the noise of a sample [rad/s], [m/s^2]
SLIP = 0.05  # standard deviation of the velocity of a standing foot, which rolls [m/s]
DT, TOUCH = 0.002, 5.0  # time between samples [s]; a foot with more force stands [N]
GRAVITY = np.array([0, 0, -9.81])
NOISE = np.diag(np.repeat([DT * GYROSCOPE, DT * ACCELEROMETER], 3) ** 2)

model = ce_gym.Model("mini_cheetah")
FEET = np.array([i for i, name in enumerate(model.contact_names) if name.endswith("foot")])
UPRIGHT = model.neutral()[:7]
contact_points = ce_gym.numba.contact_points(model)


@numba.njit
def rotation_by(x):
    """Return the rotation by a small rotation vector, shape (3, 3), by Cayley's formula."""
    S = np.cross(np.eye(3), x / 2)  # S y = (x / 2) times y
    return np.linalg.solve(np.eye(3) - S, np.eye(3) + S)


@numba.njit
def update(R, u, P, w, accelerometer, joints, joint_velocities, loads):
    """Advance rotation R, velocity u and covariance P (6, 6) of their errors, all in axes of the trunk, by a sample."""
    gravity = R.T @ GRAVITY
    A = np.eye(3) - DT * np.cross(np.eye(3), w)
    F = np.vstack((np.hstack((A, np.zeros((3, 3)))), np.hstack((DT * np.cross(np.eye(3), gravity), A))))
    u += DT * (accelerometer + gravity - np.cross(w, u))
    R[:] = R @ rotation_by(DT * w)
    P[:] = F @ P @ F.T + NOISE
    # Seen from a trunk that turns but does not move, a standing foot moves opposite to the velocity of the trunk.
    turning = np.concatenate((w, np.zeros(3), joint_velocities))
    _, velocities = contact_points(np.append(UPRIGHT, joints), turning)
    for foot in FEET[loads[FEET] > TOUCH]:
        K = np.linalg.solve(P[3:, 3:] + SLIP**2 * np.eye(3), P[3:]).T
        correction = K @ (-velocities[foot] - u)
        P -= K @ P[3:]
        R[:] = R @ rotation_by(correction[:3])
        u += correction[3:]


@numba.njit(parallel=True)
def update_all(R, u, P, w, accelerometer, joints, joint_velocities, loads):
    """Advance the estimates of all robots, the first axis of each array."""
    for i in numba.prange(len(R)):
        update(R[i], u[i], P[i], w[i], accelerometer[i], joints[i], joint_velocities[i], loads[i])


def main(n=256, n_steps=500):
    """Return errors of the direction of gravity [rad] and of the velocity [m/s], shape (n_steps, 2, n)."""
    rng = np.random.default_rng(0)
    sim = ce_gym.Simulator(model, n, dt=DT)
    swing, phase = np.tile([0.0, -0.05, 0.1], 4), np.repeat(rng.uniform(0, 2 * np.pi, (n, 4)), 3, axis=1)
    R = np.array([rotation_by(x) for x in rng.normal(0, 0.2, (n, 3))])  # wrong by 11 degrees about each axis
    u, P = np.zeros((n, 3)), np.tile(np.diag(np.repeat([0.2, 0.5], 3) ** 2), (n, 1, 1))
    errors = []
    for t in DT * np.arange(n_steps):
        last_velocity = sim.v[:, 3:6]
        sim.step(model.standing_q[7:] + swing * np.sin(4 * np.pi * t + phase))
        q, (w, velocity, joint_velocities) = sim.q, np.split(sim.v, [3, 6], axis=1)
        gravity = GRAVITY @ model.frame_pose(q, "Floating Base")[1]
        acceleration = (velocity - last_velocity) / DT + np.cross(w, velocity) - gravity
        noise = rng.normal(0, GYROSCOPE, (n, 3)), rng.normal(0, ACCELEROMETER, (n, 3))
        sensors = w + noise[0], acceleration + noise[1], q[:, 7:], joint_velocities, sim.contact_forces[..., 2]
        update_all(R, u, P, *sensors)
        angle = np.arcsin(np.linalg.norm(np.cross(gravity, GRAVITY @ R), axis=1) / 9.81**2)
        errors.append([angle, np.linalg.norm(u - velocity, axis=1)])
    return np.array(errors)


if __name__ == "__main__":
    angle, speed = main()[-100:].mean((0, 2))
    print(f"errors after 1 s: {np.degrees(angle):.2f} degrees, {speed:.3f} m/s")
