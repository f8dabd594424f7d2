"""Environment steps per second with random actions; overhead of a call; compile time."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from typing import Any

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.bench.measure.timing import Competitor, interleaved
from ce_gym.compile.system import usable_cores

MEASURED = ("exact", "armature")
"""Transmission levels."""
DTYPES = ("float64", "float32")
CALLS = 20
REQUIRED = 400_000.0
"""Required environment steps per second at the level `exact` on all cores."""

LONGEST_COMPILE = 10.0
"""Longest first `gymnasium.make`, without a kernel cache [s]."""

LONGEST_MAKE = 1.0
"""Longest `gymnasium.make` in a later process [s]."""

FIRST_STEP = """
import json, sys, time
start = time.perf_counter()
import gymnasium, ce_gym
imported = time.perf_counter()
env = gymnasium.make(sys.argv[1])
made = time.perf_counter()
env.reset(seed=0)
env.step(env.action_space.sample())
print(json.dumps([imported - start, made - imported, time.perf_counter() - made]))
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--env", default="ce_gym/MiniCheetahVelocity-v0", help="environment id")
    parser.add_argument("--num-envs", type=int, default=4096, help="environments in a batch")
    parser.add_argument("--rounds", type=int, default=5, help="how often each setting is timed")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    report = Report("throughput")
    steps_per_second(arguments, report)
    overhead(arguments, report)
    first_step(arguments, report)
    return report


def steps_per_second(arguments: argparse.Namespace, report: Report) -> None:
    """Measure steps per second by level, precision and number of threads."""
    cores = usable_cores()
    settings = [(level, d, n) for level in MEASURED for d in DTYPES for n in sorted({1, cores}, reverse=True)]
    competitors = {
        setting: stepping(
            arguments.env, arguments.num_envs, transmission=setting[0], dtype=setting[1], num_threads=setting[2]
        )
        for setting in settings
    }
    timings = interleaved({repr(s): c for s, c in competitors.items()}, arguments.rounds)
    rows = []
    for setting in settings:
        timing = timings[repr(setting)]
        rows.append((*setting, 1.0 / timing.best, 1.0 / timing.median))
    columns = ("transmission", "dtype", "threads", "best [steps/s]", "median [steps/s]")
    title = f"{arguments.env}, {arguments.num_envs} environments, random actions"
    report.tables.append(Table(title, columns, tuple(rows)))
    for level, dtype, threads, best, _ in rows:
        if level == "exact" and threads == cores:
            claim = f"exact, {dtype}, {cores} threads, at least {REQUIRED:,.0f} environment steps/s"
            report.requirements.append(Requirement(claim, f"{best:,.0f}", best >= REQUIRED))


def stepping(env_id: str, num_envs: int, **options: Any) -> Competitor:
    """Return a batch that takes `CALLS` steps with random actions drawn beforehand."""
    import gymnasium

    import ce_gym  # noqa: F401 - registers the environments

    envs = gymnasium.make_vec(env_id, num_envs=num_envs, **options)
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(CALLS)]
    return Competitor(lambda: [envs.step(action) for action in actions], num_envs * CALLS)


def overhead(arguments: argparse.Namespace, report: Report) -> None:
    """Measure the time of a call for one environment and for a batch of 8, where physics takes little time."""
    import gymnasium

    env = gymnasium.make(arguments.env)
    env.reset(seed=0)
    action = env.action_space.sample()

    def single() -> None:
        for _ in range(CALLS):
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()

    batch = stepping(arguments.env, 8, num_threads=1)
    timings = interleaved(
        {"single": Competitor(single, CALLS), "batch": Competitor(batch.run, CALLS)}, arguments.rounds
    )
    rows = (
        ("gymnasium.make, one environment", 1e6 * timings["single"].best, 1e6 * timings["single"].median),
        ("gymnasium.make_vec, 8 environments", 1e6 * timings["batch"].best, 1e6 * timings["batch"].median),
    )
    report.tables.append(Table("One call of step()", ("what", "best [us]", "median [us]"), rows))


def first_step(arguments: argparse.Namespace, report: Report) -> None:
    """Measure the first steps of a process without a kernel cache, and of the next process."""
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = (fresh_process(arguments.env, folder) for _ in range(2))
    rows = (("first process, nothing cached", *cold), ("next process", *warm))
    columns = ("process", "import [s]", "gymnasium.make [s]", "reset and step [s]")
    report.tables.append(Table("From start to first step", columns, rows))
    compile_time = cold[1] + cold[2]
    claim = f"compile of the whole environment kernel, at most {LONGEST_COMPILE:g} s"
    report.requirements.append(Requirement(claim, f"{compile_time:.2f} s", compile_time <= LONGEST_COMPILE))
    claim = f"gymnasium.make in the next process, at most {LONGEST_MAKE:g} s"
    report.requirements.append(Requirement(claim, f"{warm[1]:.2f} s", warm[1] <= LONGEST_MAKE))


def fresh_process(env_id: str, cache_folder: str) -> tuple[float, float, float]:
    """Return times of import, make, and reset with one step [s], in a new process with a given kernel cache."""
    environment = os.environ | {"CE_GYM_CACHE_DIR": cache_folder}
    command = [sys.executable, "-c", FIRST_STEP, env_id]
    finished = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if finished.returncode != 0:
        raise RuntimeError(f"{env_id} did not take a first step in a new process:\n{finished.stderr}")
    imported, made, stepped = json.loads(finished.stdout.splitlines()[-1])
    return imported, made, stepped
