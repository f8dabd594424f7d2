"""What drives that stretch cost: sub-steps at the level `elastic` over those at `exact`, standing, walking, rattling.

What they cost is a longer sub-step, and further iterations of it in which flanks of transmissions meet and let go. Both
levels have the same targets, and each run begins in the same state, so that all rounds do the same work. Walking is by
a policy: environment steps, of which sub-steps are the most.
"""

from __future__ import annotations

from typing import TypeAlias

import gymnasium
import numpy as np

from ce_gym.bench.measure.timing import Competitor
from ce_gym.dynamics.model import Model
from ce_gym.model.mechanism import ELASTIC
from ce_gym.policies import load_policy
from ce_gym.sim import Simulator

SUBSTEPS, TARGETS, SETTLED = 4, 25, 100
"""For which a target is held, how many there are in a run, and sub-steps of standing before it."""
SPREADS = (0.0, 0.3, 1.0)
"""Of targets, either way from standing [rad]."""
WALKED = 50
"""Environment steps of a run."""
LEVELS = {"without": "exact", "with": ELASTIC}

Case: TypeAlias = tuple[str, dict[str, Competitor]]


def drives(model: Model, env: str, policy: str, num_envs: int, dtype: str) -> dict[str, Case]:
    """Robots that stand, robots under random targets, and robots that walk, at both levels."""
    cases: dict[str, Case] = {}
    for spread in SPREADS:
        name = f"random targets, {spread:g} rad either way" if spread else "standing"
        sides = {side: _held(Model(model.robot, level), spread, num_envs, dtype) for side, level in LEVELS.items()}
        cases[f"elastic drives, {name}"] = ("drives", sides)
    walking = {side: _walking(env, policy, level, num_envs, dtype) for side, level in LEVELS.items()}
    return cases | {"elastic drives, walking, environment steps": ("drives", walking)}


def _held(model: Model, spread: float, num_envs: int, dtype: str) -> Competitor:
    """Sub-steps from standing, with one random target after the other."""
    sim = Simulator(model, num_envs, dtype=dtype, num_threads=1, contacts="foot")
    first = model.robot.layout.joints_q
    standing = model.standing_q[first : first + len(model.joint_links)]
    sim.step(np.tile(standing, (num_envs, 1)), n_substeps=SETTLED)
    begin, rng = sim.snapshot(), np.random.default_rng(0)
    targets = standing + rng.uniform(-spread, spread, (TARGETS, num_envs, len(standing)))

    def run() -> None:
        sim.restore(begin)
        for target in targets:
            sim.step(target, n_substeps=SUBSTEPS)

    return Competitor(run, num_envs * TARGETS * SUBSTEPS)


def _walking(env: str, policy: str, level: str, num_envs: int, dtype: str) -> Competitor:
    """Environment steps with the actions of a policy that walks at this level."""
    envs, actor = gymnasium.make_vec(env, num_envs, transmission=level, dtype=dtype, num_threads=1), load_policy(policy)
    seen, actions = envs.reset(seed=0)[0], []
    for _ in range(WALKED):
        actions.append(np.asarray(actor.predict(seen)[0]))
        seen = envs.step(actions[-1])[0]

    def run() -> None:
        envs.reset(seed=0)
        for action in actions:
            envs.step(action)

    return Competitor(run, num_envs * WALKED)
