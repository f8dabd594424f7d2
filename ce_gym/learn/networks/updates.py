"""Compiled loops of PPO: sampling of actions, advantages, Adam."""

from __future__ import annotations

import math

import numpy as np

from ce_gym.learn.networks.products import njit

ONE, ZERO = np.float32(1), np.float32(0)


@njit(cache=True)
def sample_actions(means, noise, log_std, actions, clipped, log_probs):
    """Fill actions (n, n_actions), actions clipped to -1..1, and log-probabilities (n,) of a Gaussian policy.

    `noise` (n, n_actions) are samples of the standard normal distribution.
    """
    n_actions, std = len(log_std), np.exp(log_std)
    constant = np.float32(n_actions * 0.5 * math.log(2 * math.pi))
    for j in range(n_actions):
        constant += log_std[j]
    for i in range(len(means)):
        square = ZERO
        for j in range(n_actions):
            a = means[i, j] + std[j] * noise[i, j]
            square += noise[i, j] * noise[i, j]
            actions[i, j] = a
            a = a if a < ONE else ONE
            clipped[i, j] = a if a > -ONE else -ONE
        log_probs[i] = np.float32(-0.5) * square - constant


@njit(cache=True)
def adam(theta, gradient, moments, step, rate, max_norm):
    """Make one step of Adam (Kingma & Ba 2015) with the gradient clipped to a norm.

    Changes theta (n,) and the two moments (2, n) in place.
    """
    square = 0.0
    for g in gradient:
        square += float(g) * float(g)
    shrink = np.float32(min(1.0, max_norm / (math.sqrt(square) + 1e-6)))
    b1, b2, epsilon = np.float32(0.9), np.float32(0.999), np.float32(1e-5)
    pace = np.float32(rate / (1 - 0.9**step))
    spread = np.float32(1 / math.sqrt(1 - 0.999**step))
    first, second = moments
    for i in range(len(theta)):
        g = gradient[i] * shrink
        first[i] = b1 * first[i] + (ONE - b1) * g
        second[i] = b2 * second[i] + (ONE - b2) * g * g
        theta[i] -= pace * first[i] / (np.sqrt(second[i]) * spread + epsilon)


@njit(cache=True)
def estimate_advantages(rewards, values, last_values, dones, gamma, decay, advantages):
    """Fill `advantages` with generalised advantage estimates (Schulman et al. 2016), shape (n_steps, n_envs).

    `values` (n_steps, n_envs) belong to the observations before each step, `last_values` (n_envs,) to the observations
    after the last step. Rewards after the end of an episode do not count for steps before.
    """
    n_steps, n_envs = rewards.shape
    following = last_values.copy()
    estimate = np.zeros(n_envs, np.float32)
    for t in range(n_steps - 1, -1, -1):
        for i in range(n_envs):
            going = ZERO if dones[t, i] else ONE
            delta = rewards[t, i] + gamma * going * following[i] - values[t, i]
            estimate[i] = delta + gamma * decay * going * estimate[i]
            advantages[t, i] = estimate[i]
            following[i] = values[t, i]
