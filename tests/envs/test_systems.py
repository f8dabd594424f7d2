"""Operating systems that lack what Linux has, played by taking it away; and processes that are spawned, not forked."""

import os
import subprocess
import sys

import gymnasium
import numpy as np

import ce_gym  # noqa: F401

ENV = "ce_gym/MiniCheetahVelocity-v0"
ELSEWHERE = """
import os, pathlib, sys
import casadi, gymnasium, llvmlite.binding, numpy  # they may ask the system they are on
for name in "sched_getaffinity fork register_at_fork getuid geteuid getgid getegid nice getloadavg".split():
    delattr(os, name)
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
whether = pathlib.Path.exists
pathlib.Path.exists = lambda path, **options: not str(path).startswith("/proc") and whether(path, **options)

import ce_gym
from ce_gym.__main__ import main
from ce_gym.bench.measure import machine
from ce_gym.compile import system

envs = gymnasium.make_vec("ENV", num_envs=20)
observation, _ = envs.reset(seed=3)
assert envs.unwrapped.batch.num_threads == os.cpu_count() == system.usable_cores()
assert machine.describe()["processor"]
assert system.user_number() is None
assert main(["inspect", "four_bar"]) == 0
print(observation.sum())
"""


def test_nothing_asks_for_what_only_some_systems_have():
    script = ELSEWHERE.replace("ENV", ENV)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    envs = gymnasium.make_vec(ENV, num_envs=20)
    assert done.stdout.split()[-1] == str(envs.reset(seed=3)[0].sum())


def test_spawned_processes_make_environments_of_their_own():
    """The processes get the environment's spec only: they import the package, and find the compiled kernels."""
    spawned = gymnasium.make_vec(ENV, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"})
    native = gymnasium.make_vec(ENV, num_envs=2)
    try:
        np.testing.assert_array_equal(spawned.reset(seed=5)[0], native.reset(seed=5)[0])
        actions = np.random.default_rng(0).uniform(-1, 1, (4, *native.action_space.shape)).astype(np.float32)
        for action in actions:
            for one, other in zip(spawned.step(action)[:4], native.step(action)[:4], strict=True):
                np.testing.assert_array_equal(one, other)
    finally:
        spawned.close()


def test_what_the_output_cannot_encode_is_a_question_mark():
    """The tree that `inspect` draws, into a file as Windows has it."""
    command = [sys.executable, "-X", "utf8=0", "-m", "ce_gym", "inspect", "four_bar"]
    done = subprocess.run(command, env=os.environ | {"PYTHONIOENCODING": "cp1252"}, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"??? " in done.stdout
