"""Every registered id: the checkers of Gymnasium and Stable-Baselines3 have nothing to say about its environment.

The tests check one id of each robot, and tasks and levels on one robot: each environment has to be compiled.
"""

from __future__ import annotations

import argparse
import fnmatch
import warnings

import ce_gym
from ce_gym.bench.measure.report import Report, Requirement, Table
from ce_gym.model.errors import unknown
from ce_gym.viewer.console import shown

COLUMNS = ("id", "checker", "what it says")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the benchmark."""
    parser.add_argument("pattern", nargs="?", default="*", help="which ids, as in a shell: '*Go2*'; default all")


def run(arguments: argparse.Namespace) -> Report:
    """Check every id that fits the pattern."""
    report = Report("ids")
    known = sorted(ce_gym.environment_ids())
    ids = fnmatch.filter(known, arguments.pattern)
    if not ids:
        raise unknown("ids", "pattern", arguments.pattern, known, "a pattern that fits an id")
    rows = tuple(row for env_id in shown(ids, "ids") for row in complaints(env_id))
    report.tables.append(Table("Complaints", COLUMNS, rows))
    claim = f"of {len(ids)} ids checked without a complaint"
    silent = len(ids) - len({row[0] for row in rows})
    report.requirements.append(Requirement(claim, f"{silent}", len(ids) == silent))
    report.failed = not report.requirements[0].met
    return report


def complaints(env_id: str) -> list[tuple[str, str, str]]:
    """Return rows (id, checker, first warning or error) of an id; none if the checkers are silent."""
    import gymnasium
    import gymnasium.utils.env_checker
    import stable_baselines3.common.env_checker

    checkers = {
        "gymnasium": gymnasium.utils.env_checker.check_env,
        "stable_baselines3": stable_baselines3.common.env_checker.check_env,
    }
    rows = []
    for name, check in checkers.items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                env = gymnasium.make(env_id).unwrapped
                check(env)
                env.close()
            except Exception as error:  # whatever a checker or an environment raises is its complaint
                rows.append((env_id, name, " ".join(f"{type(error).__name__}: {error}".split())))
    return rows
