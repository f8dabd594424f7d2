"""MPPI: Mini Cheetah gets up from a crouch; 256 simulated robots try out what to do next.

Source: Williams et al., "Information-theoretic model predictive control", IEEE Trans. Robotics 34(6), 2018.
"""

import numba
import numpy as np

import ce_gym
import ce_gym.numba

N_SAMPLES, HORIZON, N_SUBSTEPS = 256, 10, 8  # a plan has 10 rows of joint positions, each for 8 sub-steps of 5 ms
SPREAD, TEMPERATURE = 0.1, 0.02  # of the samples [rad]; of their weights, in units of cost
HEIGHT = 0.30  # wanted [m]

model = ce_gym.Model("mini_cheetah")
real = ce_gym.Simulator(model)
imagined = ce_gym.Simulator(model, N_SAMPLES, outputs=())
robots, step = ce_gym.numba.stepper(imagined)
set_state = ce_gym.numba.set_state(imagined)


@numba.njit
def cost(q, v):
    """Return the cost of a state: height, tilt, and speed."""
    tilt = 2 * (q[4] ** 2 + q[5] ** 2)  # 1 - cosine of the angle
    return 100 * (q[2] - HEIGHT) ** 2 + 2 * tilt + 0.1 * np.sum(v[3:6] ** 2) + 1e-3 * np.sum(v[6:] ** 2)


@numba.njit
def improve(plan, robots, q, v):
    """Return a plan (HORIZON, 12) weighted by the costs of its variations, from a state on."""
    lanes = robots.q.shape[2]
    noise = np.random.normal(0.0, SPREAD, (N_SAMPLES, HORIZON, 12))
    for row in range(1, HORIZON):
        noise[:, row] = noise[:, row - 1] + 0.3 * noise[:, row]  # smooth variations
    noise[0] = 0
    for k in range(N_SAMPLES):
        set_state(robots, k, q, v)
    costs = np.zeros(N_SAMPLES)
    for row in range(HORIZON):
        robots.target[:] = plan[row] + noise[:, row]
        step(robots, N_SUBSTEPS)
        for k in range(N_SAMPLES):
            costs[k] += cost(robots.q[k // lanes, :, k % lanes], robots.v[k // lanes, :, k % lanes])
    weights = np.exp(-(costs - costs.min()) / TEMPERATURE)
    weights /= weights.sum()
    improved = plan.copy()
    for k in range(N_SAMPLES):
        improved += weights[k] * noise[k]
    return improved


@numba.njit
def seed(number):
    """Seed the random numbers of compiled code."""
    np.random.seed(number)


def main(n_steps=60):
    """Return heights of the trunk after each step, (n_steps,) [m], and the cosine of its tilt at the end."""
    seed(0)
    q = model.standing_q.copy()
    q[7:] = np.tile([0.0, -1.3, 2.6], 4)
    q[2] -= model.contact_points(q, np.zeros(model.nv))[0][:, 2].min() - 0.02  # radius of a foot
    real.set_state(q, np.zeros(model.nv))
    plan = np.tile(q[7:], (HORIZON, 1))
    heights = []
    for _ in range(n_steps):
        plan = improve(plan, robots, real.q[0], real.v[0])
        real.step(plan[0], N_SUBSTEPS)
        plan = np.vstack([plan[1:], plan[-1:]])
        heights.append(real.q[0, 2])
    return np.array(heights), model.frame_pose(real.q[0], "Floating Base")[1][2, 2]


if __name__ == "__main__":
    heights, upright = main()
    print(f"height {heights[0]:.2f} m at first, {heights[-10:].mean():.2f} m at last; cosine of the tilt {upright:.3f}")
