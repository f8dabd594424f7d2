"""Initial states of a leg whose transmissions rattle: found at wrong figures, they have to be left at right ones."""

import numpy as np

from ce_gym.identify import simulate_log
from ce_gym.identify.excite import encoders_at
from ce_gym.identify.figures import Figure, default_kinds, sought
from ce_gym.identify.fit import Problem
from ce_gym.identify.held import held_model
from ce_gym.identify.shots import Settings, Shots
from ce_gym.identify.windows import cut, guesses
from ce_gym.model import load_robot
from ce_gym.model.mechanism import without_stretches

NOISE, SEED = 2e-4, 17
"""Of encoders [rad]; of a trial whose log begins with flanks that hit each other."""


def planted_at_random(figures: list[Figure]) -> dict[str, float]:
    """Return values of figures: delays [s], factors, friction as a share of its scale."""
    rng = np.random.default_rng([SEED, 20])
    ranges = {True: (0.7, 1.4), False: (0.3, 1.5)}
    return {
        f.name: float(rng.uniform(0.002, 0.012))
        if f.kind == "delay"
        else float(rng.uniform(*ranges[f.nominal == 1]) * (1.0 if f.nominal == 1 else f.scale))
        for f in figures
    }


def squares(problem: Problem, values: np.ndarray) -> float:
    """Return the mean square of what is left over the noise, of the worst window."""
    shown = problem.shots(values[None], problem.states[None], problem.windows.first, problem.windows.length)[0]
    return float((((shown - problem.measured) / problem.noise) ** 2).mean(axis=(1, 2)).max())


def test_states_that_were_found_at_wrong_figures_are_left_at_right_ones():
    model = held_model(load_robot("mini_cheetah"), ["HR_knee_link"], "elastic")
    measured = encoders_at(model, "both")
    figures = sought(model.robot, default_kinds(model.robot, measured), measured=measured)
    planted, robot = planted_at_random(figures), without_stretches(model.robot)
    known = {"transmission": "elastic", "encoders": "both", "noise": NOISE, "dt": 1e-3, "substep": 1e-3, "high": 20.0}
    log = simulate_log(robot, 4.2, planted=planted, amplitude=0.5, seed=SEED, **known)  # type: ignore[arg-type]
    shots = Shots(model, log, figures, Settings("position", 1e-3))
    parts = cut(log, 0.5, 0.03, 0.2)[0].parts()
    start, truth = np.array([f.start for f in figures]), np.array([planted[f.name] for f in figures])
    problem = Problem(shots, parts, guesses(shots, parts, start), np.full(len(log.measured), NOISE))
    problem.improve_states(start / problem.scale, 20)
    x = truth / problem.scale
    problem.improve_states(x, 20)
    assert squares(problem, truth) > 10, "no step leads back: if one does, this trial tests nothing"
    assert problem.begin_anew(x, guesses(shots, parts, truth)) > 0.1
    assert squares(problem, truth) < 1.5
