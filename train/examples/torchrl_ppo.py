# pyright: reportMissingImports=false
"""TorchRL's PPO on a native batch."""

import gymnasium
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

envs = gymnasium.make_vec("ce_gym:ce_gym/MiniCheetahStand-v0", num_envs=64, autoreset_mode="Disabled")
env = GymWrapper(envs)  # resets single environments itself; `GymEnv(id)` is one robot
n_actions = env.action_spec.shape[-1]
network = torch.nn.Sequential(MLP(out_features=2 * n_actions, num_cells=[64, 64]), NormalParamExtractor())
module = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
actor = ProbabilisticActor(module, ["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)
critic = ValueOperator(MLP(out_features=1, num_cells=[64, 64]), in_keys=["observation"])
reset = env.reset()
critic(actor(reset))  # fills in the sizes
loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3)
advantage = GAE(gamma=0.98, lmbda=0.95, value_network=critic)
optimizer = torch.optim.Adam(loss.parameters(), 1e-3)
for data in Collector(env, actor, frames_per_batch=4096, total_frames=1_000_000):
    for _ in range(5):
        advantage(data)
        flat = data.reshape(-1)
        for rows in torch.randperm(len(flat)).split(len(flat) // 4):
            losses = loss(flat[rows])
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()
