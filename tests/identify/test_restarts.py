"""Restarts of initial states of a leg whose transmissions rattle: the search leaves local minima."""

import numpy as np

from ce_gym.identify import simulate_log
from ce_gym.identify.base_fixed import base_fixed_model
from ce_gym.identify.excite import encoders_at
from ce_gym.identify.fit import Problem
from ce_gym.identify.parameters import Parameter, default_kinds, select_parameters
from ce_gym.identify.shooting import Shooting
from ce_gym.identify.windows import guess_states, split_log
from ce_gym.model import load_robot
from ce_gym.model.mechanism import without_stretches

NOISE, SEED = 2e-4, 17
"""Noise of encoders [rad]; seed of a log that begins with flanks that hit each other."""


def planted_at_random(parameters: list[Parameter]) -> dict[str, float]:
    """Return values of parameters: delays [s], factors, friction as a share of its scale."""
    rng = np.random.default_rng([SEED, 20])
    ranges = {True: (0.7, 1.4), False: (0.3, 1.5)}
    return {
        f.name: float(rng.uniform(0.002, 0.012))
        if f.kind == "delay"
        else float(rng.uniform(*ranges[f.nominal == 1]) * (1.0 if f.nominal == 1 else f.scale))
        for f in parameters
    }


def squares(problem: Problem, values: np.ndarray) -> float:
    """Return the mean square of the residual over noise, of the worst window."""
    shown = problem.shooting(values[None], problem.states[None], problem.windows.first, problem.windows.length)[0][0]
    return float((((shown - problem.measured) / problem.noise) ** 2).mean(axis=(1, 2)).max())


def test_restarts_leave_states_that_fit_wrong_parameters():
    model = base_fixed_model(load_robot("mini_cheetah"), ["HR_knee_link"], "elastic")
    measured = encoders_at(model, "both")
    parameters = select_parameters(model.robot, default_kinds(model.robot, measured), measured=measured)
    planted, robot = planted_at_random(parameters), without_stretches(model.robot)
    known = {"transmission": "elastic", "encoders": "both", "noise": NOISE, "dt": 1e-3, "substep": 1e-3, "high": 20.0}
    log = simulate_log(robot, 4.2, planted=planted, amplitude=0.5, seed=SEED, **known)  # type: ignore[arg-type]
    shooting = Shooting(model, log, parameters, 1e-3)
    parts = split_log(log, 0.5, 0.03, 0.2)[0].parts()
    start, truth = np.array([p.start for p in parameters]), np.array([planted[p.name] for p in parameters])
    problem = Problem(shooting, parts, guess_states(shooting, parts, start), np.full(len(log.measured), NOISE))
    problem.improve_states(start / problem.scale, 20)
    x = truth / problem.scale
    problem.improve_states(x, 20)
    assert squares(problem, truth) > 10, "no step leads back, else this test is void"
    assert problem.restart_states(x, guess_states(shooting, parts, truth)) > 0.1
    assert squares(problem, truth) < 1.5
