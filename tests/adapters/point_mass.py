"""A toy vector environment that has the interface of ours: a point that must move at a commanded speed.

It exists so that the shells for learners and the training scripts are tested without a robot: one action is a force,
the observation is (speed, command), the reward is one minus the squared error of speed. In a dictionary of
observations the critic sees the clock as well.
"""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

ID = "test/PointMassVelocity-v0"


class PointMassVectorEnv(VectorEnv):
    def __init__(
        self,
        num_envs,
        autoreset_mode=AutoresetMode.SAME_STEP,
        transmission="exact",
        horizon=50,
        standard=False,
        obs_mode="vector",
        **_,
    ):
        self.num_envs, self.horizon, self.standard, self.obs_mode = num_envs, horizon, standard, obs_mode
        self.max_episode_steps = horizon
        self.model = SimpleNamespace(robot=SimpleNamespace(name="point", source=""), transmission=transmission)
        self.metadata = {"autoreset_mode": AutoresetMode(autoreset_mode), "render_fps": 50, "render_modes": []}
        self.render_mode = None
        seen, known = (Box(-np.inf, np.inf, (size,), np.float32) for size in (2, 3))
        self.single_observation_space = Dict({"policy": seen, "critic": known}) if obs_mode == "dict" else seen
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.batch = SimpleNamespace(write=self._write)
        self.gain = {"exact": 0.2, "coupled": 0.2, "armature": 0.15, "none": 0.1}[transmission]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.fixed = (options or {}).get("command")
        self.speed, self.command, self.error, self.total = (np.zeros(self.num_envs) for _ in range(4))
        self.clock = np.zeros(self.num_envs, int)
        self._restart(np.ones(self.num_envs, bool))
        return self._obs(), {}

    def step(self, actions):
        assert actions.shape == (self.num_envs, 1)
        self.speed = self.speed + self.gain * np.clip(actions[:, 0], -1, 1)
        error = np.abs(self.speed - self.command)
        reward = (1.0 - error**2).astype(np.float32)
        self.clock, self.error, self.total = self.clock + 1, self.error + error, self.total + reward
        diverged = np.abs(self.speed) > 8.0
        terminated = np.abs(self.speed) > 3.0
        truncated = self.clock >= self.horizon
        done = terminated | truncated
        infos = {"diverged": diverged}
        if done.any():
            infos |= self._ending(done)
            self._restart(done)
        return self._obs(), reward, terminated, truncated, infos

    @property
    def elapsed_steps(self):
        return self.clock.copy()

    @elapsed_steps.setter
    def elapsed_steps(self, steps):
        self.clock[:] = steps

    def policy_spec(self):
        return {"format": "toy", "transmission": self.model.transmission, "joints": ["slider"], "control_dt": 0.02}

    def state(self):
        v = np.zeros((self.num_envs, 7))
        v[:, 3] = self.speed
        command = np.stack([self.command, 0 * self.command, 0 * self.command], axis=1)
        return {
            "q": np.zeros((self.num_envs, 8)),
            "v": v,
            "contact_forces": np.zeros((self.num_envs, 1, 3)),
            "command": command,
        }

    def _write(self, name, rows):
        assert name == "command"
        self.command[:] = rows[:, 0]

    def _ending(self, done):
        if self.standard:  # reports no sums of its own
            return {"final_obs": self._obs(), "_final_obs": done}
        sums = {"length": self.clock.copy(), "return": self.total.copy(), "reward/speed": self.total.copy()}
        sums["metrics/velocity_error"] = self.error / np.maximum(self.clock, 1)
        return {"final_obs": self._obs(), "_final_obs": done, "episode_terms": sums, "_episode_terms": done}

    def _restart(self, lanes):
        for array in (self.speed, self.error, self.total, self.clock):
            array[lanes] = 0
        drawn = self.np_random.uniform(-1, 1, self.num_envs)
        self.command[lanes] = drawn[lanes] if self.fixed is None else self.fixed[0]

    def _obs(self):
        seen = np.stack([self.speed, self.command], axis=1).astype(np.float32)
        if self.obs_mode == "vector":
            return seen
        return {"policy": seen, "critic": np.column_stack([seen, self.clock / self.horizon]).astype(np.float32)}


if ID not in gymnasium.registry:
    gymnasium.register(ID, vector_entry_point=PointMassVectorEnv)
