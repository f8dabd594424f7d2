"""The threaded learner computes what Stable-Baselines3's own computes, on any number of threads."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from callbacks import EntropySchedule, NoiseSchedule
from learner import ThreadedPPO
from point_mass import ID
from stable_baselines3 import PPO

from ce_gym.adapters.sb3 import make_sb3_vec_env
from ce_gym.adapters.sb3_asymmetric import AsymmetricPolicy


def weights(cls, threads=1, minibatches=1, policy="MlpPolicy", **env_kwargs):
    """All parameters after three rollouts and nine updates."""
    envs = make_sb3_vec_env(ID, 16, seed=2, **env_kwargs)
    # Plain descent shows the length of a gradient, which Adam would hide; a narrow range, that ratios are clipped.
    descent = {"policy_kwargs": {"optimizer_class": torch.optim.SGD}, "learning_rate": 0.03, "max_grad_norm": 1e9}
    model = cls(
        policy,
        envs,
        n_steps=20,
        batch_size=320 // minibatches,
        n_epochs=3,
        seed=1,
        device="cpu",
        ent_coef=0.01,
        clip_range=0.02,
        **descent,
    )
    model.threads = threads
    torch.set_num_threads(1)
    model.learn(3 * 320)
    return np.concatenate([p.detach().numpy().ravel() for p in model.policy.parameters()]), model.logger


def test_it_is_ppo():
    """With one minibatch per epoch the order of samples does not matter, so the two must agree."""
    ours, our_log = weights(ThreadedPPO)
    theirs, their_log = weights(PPO)
    np.testing.assert_allclose(ours, theirs, atol=5e-5)
    untrained = PPO("MlpPolicy", make_sb3_vec_env(ID, 16), seed=1, device="cpu").policy
    start = np.concatenate([p.detach().numpy().ravel() for p in untrained.parameters()])
    assert np.abs(theirs - start).max() > 20 * 5e-5  # the tolerance is far below what learning changes
    for key in ("train/approx_kl", "train/std", "train/explained_variance"):
        assert our_log.name_to_value[key] == pytest.approx(their_log.name_to_value[key], rel=1e-2, abs=1e-5)


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_the_result(threads):
    np.testing.assert_array_equal(weights(ThreadedPPO, minibatches=4)[0], weights(ThreadedPPO, threads, 4)[0])


def test_it_is_ppo_on_dictionaries_too():
    kwargs = {"policy": AsymmetricPolicy, "obs_mode": "dict"}
    ours, theirs = (weights(cls, **kwargs)[0] for cls in (ThreadedPPO, PPO))
    np.testing.assert_allclose(ours, theirs, atol=5e-5)


def test_the_noise_shrinks_by_the_same_factor_in_every_step():
    schedule = NoiseSchedule(0.6, 0.006, 1000)
    schedule.model = SimpleNamespace(policy=SimpleNamespace(log_std=torch.zeros(3)))
    for steps, std in ((0, 0.6), (500, 0.06), (1000, 0.006), (1500, 0.006)):
        schedule.num_timesteps = steps
        schedule.on_rollout_start()
        np.testing.assert_allclose(schedule.model.policy.log_std.exp(), std, rtol=1e-6)


def test_the_entropy_bonus_fades_in_proportion_to_steps():
    schedule = EntropySchedule(0.003, 0.001, 1000)
    schedule.model = SimpleNamespace(ent_coef=None)
    for steps, weight in ((0, 0.003), (500, 0.002), (1000, 0.001), (1500, 0.001)):
        schedule.num_timesteps = steps
        schedule.on_rollout_start()
        assert schedule.model.ent_coef == pytest.approx(weight)
