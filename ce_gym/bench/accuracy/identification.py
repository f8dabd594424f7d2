"""How often intervals of identified figures hold what was planted, and how far estimates are off: one leg, many logs.

Each log is simulated with figures of its own and the noise of encoders, at the step that it is identified with: what is
left is noise. Figures that data cannot separate are held by the search; the truth is then that of their combination.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.dynamics import Model
from ce_gym.identify import Figure, Identified, identify, simulate_log
from ce_gym.identify.excite import ENCODERS, encoders_at
from ce_gym.identify.figures import default_kinds, sought
from ce_gym.identify.held import held_model
from ce_gym.model import load_robot
from ce_gym.model.mechanism import ELASTIC, LEVELS, without_stretches

Array = NDArray[np.float64]
FACTORS, SHARES, DELAYS = (0.7, 1.4), (0.3, 1.5), (0.002, 0.012)
"""What is planted: factors, friction over its scale, delays [s]; uniform."""
COVERED = 0.91, 0.99
"""Of 95 % intervals."""
LARGEST_ERROR = 0.02
RATES = {False: {"dt": 5e-3, "substep": 5e-3, "high": 6.0}, True: {"dt": 1e-3, "substep": 1e-3, "high": 20.0}}
"""Of rows and steps [s], and the highest frequency of chirps [Hz]; where transmissions stretch, they oscillate."""


@dataclass(frozen=True)
class Subject:
    """What is identified.

    Attributes:
        model: A leg.
        encoders: Where its encoders are, one of `ENCODERS`.
        seconds: Length of a log.
        noise: Of encoders [rad].
    """

    model: Model
    encoders: str = "joints"
    seconds: float = 8.0
    noise: float = 2e-4

    @property
    def figures(self) -> list[Figure]:
        """Which are planted and sought."""
        measured = encoders_at(self.model, self.encoders)
        return sought(self.model.robot, default_kinds(self.model.robot, measured), measured=measured)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--robot", default="mini_cheetah", help="name or path")
    parser.add_argument("--limb", default="HR_knee_link", help="a link of the leg that is identified")
    parser.add_argument("--trials", type=int, default=200, help="how many logs")
    parser.add_argument("--seconds", type=float, default=8.0, help="length of each")
    parser.add_argument("--noise", type=float, default=2e-4, help="of encoders, each where it is [rad]")
    parser.add_argument("--transmission", default="exact", choices=(*LEVELS, ELASTIC), help="level (default exact)")
    parser.add_argument("--encoders", default="joints", choices=ENCODERS, help="where they are (default joints)")


def run(arguments: argparse.Namespace) -> Report:
    """Run the benchmark."""
    report, began = Report("identification"), time.process_time()
    leg = held_model(load_robot(arguments.robot), [arguments.limb], arguments.transmission)
    subject = Subject(leg, arguments.encoders, arguments.seconds, arguments.noise)
    names = [figure.name for figure in subject.figures]
    trials = [trial(subject, seed) for seed in range(arguments.trials)]
    errors, stds = np.moveaxis(np.array(trials), 1, 0)
    rows = tabulate(names, errors, stds)
    columns = ("figure", "trials", "covered", "rms error / std", "rms error", "median std", "largest error")
    title = f"{leg.robot.name}, {arguments.limb}, {arguments.transmission}, encoders at {arguments.encoders}"
    title += f": {arguments.trials} logs of {arguments.seconds:g} s, errors relative"
    report.tables.append(Table(title, columns, tuple(rows)))
    low, high = COVERED
    claim = f"intervals of each figure hold it in {100 * low:g} to {100 * high:g} % of trials"
    least, most = (f([row[2] for row in rows]) for f in (min, max))
    report.requirements.append(
        Requirement(claim, f"{100 * least:.1f} to {100 * most:.1f} %", low <= least and most <= high)
    )
    claim = f"each figure within {100 * LARGEST_ERROR:g} % of what was planted, root mean square"
    worst = max(rows[:-1], key=lambda row: row[4])
    report.requirements.append(Requirement(claim, f"{worst[0]} {100 * worst[4]:.2f} %", worst[4] <= LARGEST_ERROR))
    report.remarks.append(f"{(time.process_time() - began) / arguments.trials:.1f} s of processor time a trial")
    return report


def trial(subject: Subject, seed: int) -> Array:
    """Return errors of estimates and standard deviations, relative to the truth, shape (2, P); 0 where it is held."""
    planted, level = draw(subject, seed), subject.model.mechanism.level
    rates, leg = RATES[level == ELASTIC], without_stretches(subject.model.robot)
    known: dict[str, Any] = {"transmission": level, "encoders": subject.encoders, "noise": subject.noise, **rates}
    log = simulate_log(leg, subject.seconds, planted=planted, amplitude=0.5, seed=seed, **known)
    found = identify(leg, log, substep=rates["substep"], transmission=level)
    truth = combined(found, planted)
    return np.stack([(found.values - truth) / truth, found.std / truth])


def draw(subject: Subject, seed: int) -> dict[str, float]:
    """Return figures to plant, by name."""
    rng = np.random.default_rng([seed, 20])
    return {figure.name: _drawn(figure, rng) for figure in subject.figures}


def _drawn(figure: Figure, rng: np.random.Generator) -> float:
    if figure.kind == "delay":
        return float(rng.uniform(*DELAYS))
    return float(rng.uniform(*FACTORS) if figure.nominal == 1 else figure.scale * rng.uniform(*SHARES))


def combined(found: Identified, planted: dict[str, float]) -> Array:
    """Return what estimates should be, given that some figures are held at what they are not.

    What is held shifts only what is found (`ce_gym.identify.separable.held_of`), so that no shift goes into another.
    """
    truth = dict(planted)
    for which in found.held:
        for figure, much in which.taken:
            truth[figure.name] += much * (planted[which.figure.name] - which.figure.nominal)
    return np.array([truth[figure.name] for figure in found.figures])


def tabulate(names: list[str], errors: Array, stds: Array) -> list[tuple]:
    """Return a row for each figure that was ever sought, and one for all; errors and deviations relative (N, P)."""
    rows = []
    for i, name in [*enumerate(names), (slice(None), "all")]:
        error, std = errors[:, i].ravel(), stds[:, i].ravel()
        error, std = error[std > 0], std[std > 0]
        if len(error):
            score = error / std
            shares = float((np.abs(score) < 1.959964).mean()), float(np.sqrt((score**2).mean()))
            sizes = float(np.sqrt((error**2).mean())), float(np.median(std)), float(np.abs(error).max())
            rows.append((name, len(error), *shares, *sizes))
    return rows
