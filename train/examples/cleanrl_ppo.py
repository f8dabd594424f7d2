"""PPO in one file in the manner of CleanRL, on a native batch."""

import gymnasium
import torch
from torch import nn

torch.set_num_threads(1)  # fastest for small networks
envs = gymnasium.make_vec("ce_gym:ce_gym/MiniCheetahVelocity-v0", num_envs=512, autoreset_mode="SameStep")
obs = torch.tensor(envs.reset(seed=0)[0])
n_obs, n_act = obs.shape[1], envs.action_space.sample().shape[1]
actor = nn.Sequential(nn.Linear(n_obs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, n_act))
critic = nn.Sequential(nn.Linear(n_obs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))
log_std = nn.Parameter(torch.full((n_act,), -0.5))
adam = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], 1e-3)
for _ in range(4_000_000 // (24 * 512)):
    rollout = []
    with torch.no_grad():
        for _ in range(24):
            policy = torch.distributions.Normal(actor(obs), log_std.exp())
            action = policy.sample()
            following, reward, terminated, truncated, _ = envs.step(action.clamp(-1, 1).numpy())
            alive = torch.tensor(~(terminated | truncated))
            rollout.append([obs, action, policy.log_prob(action), critic(obs)[:, 0], torch.tensor(reward), alive])
            obs = torch.tensor(following)
        advantage, next_value = 0.0, critic(obs)[:, 0]
        for step in reversed(rollout):  # generalised advantage estimation
            value, reward, alive = step[3:]
            advantage = reward + 0.98 * alive * (next_value + 0.95 * advantage) - value
            step[4:], next_value = [advantage, advantage + value], value
    print(f"reward per step {reward.mean():.4f}", flush=True)
    batch = [torch.cat(column).float() for column in zip(*rollout, strict=True)]
    for rows in torch.cat([torch.randperm(24 * 512) for _ in range(3)]).split(3072):
        observed, action, log_prob, _, advantage, target = (column[rows] for column in batch)
        ratio = (torch.distributions.Normal(actor(observed), log_std.exp()).log_prob(action) - log_prob).sum(1).exp()
        gain = (advantage - advantage.mean()) / advantage.std()
        loss = (critic(observed)[:, 0] - target).square().mean() / 2
        loss -= torch.min(ratio * gain, ratio.clip(0.8, 1.2) * gain).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
