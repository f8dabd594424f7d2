"""Sub-steps and environment steps per second on a GPU. All functions need a GPU."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from ce_gym.bench.measure.report import Table
from ce_gym.dynamics.model import Model
from ce_gym.sim import Simulator
from ce_gym.sim.devices import Device

SUBSTEPS = 20
"""Sub-steps of a launch; targets jump between launches, as in the CPU benchmark."""
CALLS = 10
DT = 0.005
Rates = dict[str, dict[int, float]]
"""Rates per second by name and batch size."""


class Unmeasured(Exception):
    """A rate was not measured; the message is the reason in one line."""


def name_of(device: Device) -> str:
    """Return the GPU's name."""
    import torch

    return torch.cuda.get_device_name(device.name)


def best_rate(work: Callable[[], object], amount: int, rounds: int) -> float:
    """Return the highest rate of `rounds` synchronised rounds, after one round for compilation and warm-up."""
    import torch

    seconds = []
    for _ in range(rounds + 1):
        torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        torch.cuda.synchronize()
        seconds.append(time.perf_counter() - start)
    return amount / min(seconds[1:])


def substeps(robot: str, device: Device, sizes: Sequence[int], dtypes: Sequence[str], rounds: int) -> Rates:
    """Return sub-steps per second of robots that stand on their feet and follow changing targets."""
    import torch

    rates: Rates = {}
    model = Model(robot, "exact")
    joints = len(model.joint_links)
    for dtype in dtypes:
        for size in sizes:
            sim = Simulator(model, size, DT, dtype, contacts="foot", outputs=(), device=device)
            jitter = 0.1 * torch.rand((4, size, joints), device=device.name, dtype=getattr(torch, dtype)) - 0.05
            targets = torch.as_tensor(model.standing_q[-joints:], device=device.name).to(jitter.dtype) + jitter

            def work(sim: Simulator = sim, targets: Any = targets) -> None:
                for call in range(CALLS):
                    sim.step(targets[call % 4], SUBSTEPS)

            rate = best_rate(work, size * CALLS * SUBSTEPS, rounds)
            if sim.n_diverged:
                raise Unmeasured(f"{sim.n_diverged} of {size} robots diverged in {dtype}")
            rates.setdefault(f"ours, {dtype}", {})[size] = rate
    return rates


def environment(robot: str, device: Device, sizes: Sequence[int], dtypes: Sequence[str], rounds: int) -> Rates:
    """Return environment steps per second of the velocity task with random actions and resets."""
    import torch

    from ce_gym.envs.vector import LeggedVectorEnv

    rates: Rates = {}
    for dtype in dtypes:
        for size in sizes:
            envs = LeggedVectorEnv(size, device, robot=robot, task="velocity", dtype=dtype)
            envs.reset(seed=0)
            actions = 2 * torch.rand((4, size, envs.batch.program.n_actions), device=device.name) - 1

            def work(envs: LeggedVectorEnv = envs, actions: Any = actions) -> None:
                for call in range(CALLS):
                    envs.step(actions[call % 4])

            rates.setdefault(f"ours, {dtype}", {})[size] = best_rate(work, size * CALLS, rounds)
    return rates


def rate_table(title: str, rates: Rates) -> Table:
    """Return a table of rates by batch size, with one column for each name."""
    sizes = sorted({size for by_size in rates.values() for size in by_size})
    rows = tuple((size, *(by_size.get(size) for by_size in rates.values())) for size in sizes)
    return Table(title, ("robots", *rates), rows)
