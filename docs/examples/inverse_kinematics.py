"""Inverse kinematics: move a foot to 1000 points at once by damped least squares."""

import numpy as np

import ce_gym

DAMPING = 1e-2  # bounds the steps near singularities, such as a stretched leg [m]


def inverse_kinematics(model, q, frame, points, n_iterations=50):
    """Return positions (n, nq), from q (n, nq) on, where the origin of a frame is at points (n, 3); the base stays."""
    first = model.nv - len(model.joint_names)  # column of the first joint: 6 with a floating base
    for _ in range(n_iterations):
        error = points - model.frame_pose(q, frame)[0]
        J = model.frame_jacobian(q, frame)[..., 3:, first:]  # linear rows, columns of the joints
        JT = np.swapaxes(J, -1, -2)
        dv = np.zeros((len(q), model.nv))
        dv[:, first:] = (JT @ np.linalg.solve(J @ JT + DAMPING**2 * np.eye(3), error[..., None]))[..., 0]
        q = model.integrate(q, dv)
    return q


def main():
    """Return the largest distance of a foot from its point [m]."""
    model = ce_gym.Model("mini_cheetah")
    q = np.tile(model.standing_q, (1000, 1))
    foot, _ = model.frame_pose(model.standing_q, "FL_foot")
    points = foot + np.random.default_rng(0).uniform(-0.05, 0.05, (1000, 3))

    q = inverse_kinematics(model, q, "FL_foot", points)
    return np.linalg.norm(model.frame_pose(q, "FL_foot")[0] - points, axis=1).max()


if __name__ == "__main__":
    print(f"largest error {1000 * main():.1e} mm")
