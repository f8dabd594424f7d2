"""Whole-body control: Mini Cheetah stands on three legs while its fourth foot draws a circle.

The tasks give 18 accelerations for 18 velocities: centre of mass (3), rotation of the trunk (3), and four feet (12).
"""

import numpy as np
from scipy.optimize import nnls

import ce_gym

FRICTION = 0.6
EDGES = np.array([[FRICTION, 0, 1], [-FRICTION, 0, 1], [0, FRICTION, 1], [0, -FRICTION, 1]]).T  # of a friction pyramid
KP, KD = 400.0, 40.0  # gains of the tasks [1/s^2], [1/s]
SMALL = 1e-3  # weight of the forces beside the error of the wrench on the trunk
RADIUS, RATE, LIFT = 0.03, 2 * np.pi, np.array([0, 0, 0.08])  # of the circle [m], [rad/s], [m]
LIFT_OFF = 0.5  # [s]

model = ce_gym.Model("mini_cheetah")
FEET = ["HR_foot", "HL_foot", "FR_foot", "FL_foot"]  # the last one draws
HOME, _ = model.contact_points(model.standing_q, np.zeros(model.nv), FEET)
START = model.center_of_mass(model.standing_q)
ABOVE_THREE_FEET = np.append(HOME[:3, :2].mean(0), START[2])


def foot_reference(t):
    """Return position, velocity and acceleration of the drawing foot."""
    rise = np.clip((t - LIFT_OFF) / 0.5, 0, 1)
    spoke = RADIUS * np.array([np.sin(RATE * t), np.cos(RATE * t), 0])
    tangent = RADIUS * np.array([np.cos(RATE * t), -np.sin(RATE * t), 0])
    return HOME[3] + rise * (LIFT + spoke), rise * RATE * tangent, -rise * RATE**2 * spoke


def desired_acceleration(t, q, v, J):
    """Return the acceleration `vdot` (18,) that follows the references."""
    _, rotation = model.frame_pose(q, "Floating Base")
    center, feet = model.center_of_mass(q), model.contact_points(q, v, FEET)[0]
    foot, foot_velocity, foot_acceleration = foot_reference(t)
    share = min(t / LIFT_OFF, 1)
    turn = rotation @ model.difference(q, model.standing_q)[:3]  # to the upright pose, in the axes of the world
    error = np.concatenate([START + share * (ABOVE_THREE_FEET - START) - center, turn, np.zeros(9), foot - feet[3]])
    velocity, acceleration = np.zeros(18), np.zeros(18)
    velocity[15:], acceleration[15:] = foot_velocity, foot_acceleration
    bias = [
        model.center_of_mass_bias_acceleration(q, v),
        model.frame_bias_acceleration(q, v, "Floating Base")[:3],
        model.contact_bias_acceleration(q, v, FEET).ravel(),
    ]
    return np.linalg.solve(J, acceleration + KP * error + KD * (velocity - J @ v) - np.concatenate(bias))


def control(t, q, v):
    """Return the torques of the joints (12,)."""
    J_feet = model.contact_jacobian(q, FEET)
    J_trunk = model.frame_jacobian(q, "Floating Base")[:3]
    J = np.vstack([model.center_of_mass_jacobian(q), J_trunk, *J_feet])
    force = model.inverse_dynamics(q, v, desired_acceleration(t, q, v, J))  # M vdot + h
    n = 4 if t < LIFT_OFF else 3
    generators = np.hstack([J.T @ EDGES for J in J_feet[:n]])  # J^T f = generators @ lambda, lambda >= 0
    # The trunk has no motor: its 6 rows of M vdot + h = tau + J^T f determine the contact forces.
    A = np.vstack([generators[:6], SMALL * np.eye(4 * n)])
    amounts, _ = nnls(A, np.append(force[:6], np.zeros(4 * n)))
    return (force - generators @ amounts)[6:]


def main(duration=3.0):
    """Return position of the foot minus its reference, (n, 3) [m], and heights of the trunk, (n,) [m]."""
    sim = ce_gym.Simulator(model, dt=0.001, control="torque")
    errors, heights = [], []
    for t in np.arange(0, duration, sim.dt):
        q, v = sim.q[0], sim.v[0]
        sim.step(control(t, q, v))
        errors.append(model.contact_points(q, v, FEET)[0][3] - foot_reference(t)[0])
        heights.append(q[2])
    return np.array(errors), np.array(heights)


if __name__ == "__main__":
    errors, heights = main()
    print(f"largest error of the foot on the circle {1000 * np.abs(errors[1500:]).max():.1f} mm")
    print(f"height of the trunk {heights.min():.3f} to {heights.max():.3f} m")
