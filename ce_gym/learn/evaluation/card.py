"""Evaluate the policy of a training run and write its card: training, results, and the command that repeats it."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ce_gym.files import CARD, PICTURE, check_output, write_file
from ce_gym.learn.evaluation.crossing import cross
from ce_gym.learn.evaluation.effort import effort
from ce_gym.learn.evaluation.episodes import weights_seed
from ce_gym.learn.evaluation.evaluation import evaluate, load
from ce_gym.learn.evaluation.pictures import draw_curve
from ce_gym.learn.evaluation.pushes import push_envelope
from ce_gym.learn.evaluation.sim2sim import compare, comparison_table
from ce_gym.learn.evaluation.suites import evaluate_suites
from ce_gym.learn.evaluation.tables import metrics, sections, table, two_columns
from ce_gym.learn.runs.progress import LOG, read_curve
from ce_gym.learn.runs.settings import config_file, load_settings
from ce_gym.learn.training import learner, learner_of
from ce_gym.model.mechanism import LEVELS
from ce_gym.policies import Policy, PolicyError, keep_map, locate_policy, read_actor, registered, shelf, write_npz

FINER = 5
"""Ratio of sub-step lengths of a second evaluation, because a policy may rely on the length of its training."""

OF_TRAINING = ("resumed_from", "seed", "settings", "steps", "training_seconds", "date", "versions")
"""Keys of a record that a card needs, and that training alone writes."""


def card_results(
    policy: Policy, episodes: int, sim2sim_episodes: int, levels: Sequence[str] = LEVELS
) -> dict[str, Any]:
    """Return all results for the card of a policy.

    Args:
        policy: Policy with its record.
        episodes: Episodes at each level, and of each suite.
        sim2sim_episodes: Episodes in MuJoCo; 0 skips MuJoCo.
        levels: Levels of the evaluation, in addition to the training level.

    Returns:
        - seed: Seed of all evaluations, computed from the weights.
        - levels: Result of `evaluate` by level.
        - finer: The same at the training level with sub-steps `FINER` times shorter.
        - effort, suites, pushes: Results at the training level.
        - crossing: See `crossing.cross`, if the ground has levels.
        - sim2sim: Result in MuJoCo, or sim2sim_missing: why there is no result.

        Policies without commands have no suites, crossing, pushes and sim2sim.
    """
    record, seed = policy.record, weights_seed(policy)
    env_id, kwargs, spec, trained = (record[key] for key in ("env", "env_kwargs", "policy_spec", "transmission"))
    common = {"episodes": episodes, "seed": seed}
    by_level = {
        level: evaluate(policy, env_id, **common, **{**kwargs, "transmission": level})
        for level in dict.fromkeys((*levels, trained))
    }
    longest = registered(env_id).max_episode_steps or math.inf
    result: dict[str, Any] = {
        "seed": seed,
        "levels": by_level,
        "finer": evaluate(policy, env_id, **common, **{**kwargs, **_shorter(spec)}),
        "effort": effort(policy, seconds=min(10.0, longest * spec["control_dt"]), seed=seed, **kwargs),
    }
    if not by_level[trained]["commanded"]:
        return result | {"sim2sim_missing": "the policy has no commands, which the comparison needs"}
    result["suites"] = evaluate_suites(policy, **common, **kwargs)
    result["pushes"] = push_envelope(policy, seed=seed, **kwargs)
    if "levels" in by_level[trained]:
        result["crossing"] = cross(policy, **common, **kwargs)
    if not sim2sim_episodes:
        return result | {"sim2sim_missing": "not requested"}
    try:
        return result | {"sim2sim": compare(policy, episodes=sim2sim_episodes, seed=seed)}
    except ImportError:
        return result | {"sim2sim_missing": "MuJoCo is not installed: pip install ce_gym[mjcf]"}
    except ValueError as error:  # MuJoCo cannot express every robot
        why = " ".join(str(error).split()).replace(f"{shelf().parent}/", "")  # no paths in cards
        return result | {"sim2sim_missing": why}


def _shorter(spec: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment with the same control steps and `FINER` times as many sub-steps."""
    dt = spec["physics_dt"] / FINER
    return {"dt": dt, "n_substeps": round(spec["control_dt"] / dt)}


def command(record: dict[str, Any]) -> str:
    """Return the command line that repeats a training run.

    Raises:
        PolicyError: If training continued from another policy, so that no single command repeats it.
    """
    if record["resumed_from"]:
        raise PolicyError(f"resumed from {record['resumed_from']}; expected a run from the beginning")
    algo = learner_of(record)
    words = ["python", "-m", "ce_gym", "train", record["env"], "--algo", algo, "--seed", str(record["seed"])]
    kwargs = dict(record["env_kwargs"])
    if level := kwargs.pop("transmission", None):
        words += ["--transmission", level]
    if isinstance(kwargs.get("critic"), list) and kwargs.pop("obs_mode", None) == "dict":
        words += ["--critic", *kwargs.pop("critic")]
    for key, value in kwargs.items():
        words += ["--env-arg", f"{key}={json.dumps(value)}"]
    kind = learner(algo).Settings
    usual = json.loads(json.dumps(asdict(load_settings(config_file(record["env"], kind.folder), kind=kind))))
    # A deadline may have ended training, so the steps done replace the setting.
    chosen = record["settings"] | {"steps": min(record["settings"]["steps"], record["steps"])}
    changed = {key: value for key, value in chosen.items() if value != usual[key]}
    texts = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in changed.items()}
    words += ["--set", *(f"{key}={text}" for key, text in texts.items())] if texts else []
    return shlex.join(words)


def card(record: dict[str, Any], result: dict[str, Any], curve: list[dict[str, float]], name: str) -> str:
    """Return the card as Markdown.

    Args:
        record: Record of the policy.
        result: Result of `card_results`.
        curve: Rows of the learning curve.
        name: Name of the policy.
    """
    seconds = max([record["training_seconds"], *(row["seconds"] for row in curve)])
    facts = {
        "environment": f"`{record['env']}`",
        "trained on": f"`{record['transmission']}` transmissions",
        "seed": record["seed"],
        "steps": f"{record['steps']:,}",
        "wall-clock time": f"{seconds:.0f} s",
        "processor time": f"{spent:.0f} s" if (spent := record.get("processor_seconds")) else "unknown",
        "observation, action": f"{record['observation_size']} numbers, {record['action_size']} numbers",
        "date": record["date"],
        "versions": ", ".join(f"{package} {number}" for package, number in record["versions"].items()),
    }
    try:
        repeat = f"Trained by\n\n```sh\n{command(record)}\n```"
    except PolicyError as error:
        repeat = f"No single command repeats it: {error}"
    in_mujoco = f"Not evaluated: {result.get('sim2sim_missing')}"
    if "sim2sim" in result:
        in_mujoco = f"{comparison_table(result['sim2sim'])} Commands are random, one for each robot."
    trained = result["levels"].get(record["transmission"], {})
    parts = [
        f"# {name}",
        two_columns("what", "", facts),
        repeat,
        *(["![Learning curve](curve.png)"] if curve else []),
        f"## On transmission levels\n\n{_levels(record, result)}",
        *sections({**result, "levels": trained.get("levels")}),
        f"## In MuJoCo\n\n{in_mujoco}",
        f"## Settings\n\n{two_columns('setting', 'value', record['settings'])}",
    ]
    return "\n\n".join(parts) + "\n"


def _levels(record: dict[str, Any], result: dict[str, Any]) -> str:
    level, spec, finer = record["transmission"], record["policy_spec"], result["finer"]
    results = {f"`{name}`" + " (trained)" * (name == level): each for name, each in result["levels"].items()}
    results[f"`{level}`, sub-steps of {1e3 * _shorter(spec)['dt']:g} ms"] = finer
    keys = ("forward_error", "lateral_error", "yaw_rate_error") if finer["commanded"] else tuple(metrics(finer))
    rows = {name: each | metrics(each) for name, each in results.items()}
    what = "Mean absolute errors over every step" if finer["commanded"] else "Means, in SI units,"
    notes = (
        f"{what} of {finer['episodes']} episodes of the mean action.",
        f"A step is {spec['control_dt']:g} s, of sub-steps of {spec['physics_dt'] * 1e3:g} ms.",
        f"Seed {result['seed']}: the first 32 bits of the SHA-256 of the weights.",
        f"Other results are at level `{level}` unless named otherwise.",
    )
    return f"{table('evaluated at', rows, *keys, 'falls', 'reward')}\n\n{' '.join(notes)}"


def short_name(record: dict[str, Any], task: str | None = None) -> str:
    """Return the name under which a policy is shipped; `task` replaces the name of its task.

    Raises:
        PolicyError: If robot, task and level of the record do not make the name of a folder.
    """
    spec = record["policy_spec"]
    name = "_".join(str(x) for x in (spec.get("robot"), task or spec.get("task"), record["transmission"]))
    if not re.fullmatch(r"[\w-]+", name):
        raise PolicyError(f"policy_spec: robot, task and level {name!r}; expected letters, digits, _ and - only")
    return name


def portable(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without paths of this machine."""
    resumed, kwargs = record.get("resumed_from"), dict(record["env_kwargs"])
    terrain = kwargs.get("terrain")
    if isinstance(terrain, Mapping) and "file" in terrain:  # a copy is in the folder of the policy
        kwargs["terrain"] = {**terrain, "file": Path(terrain["file"]).name}
    settings = record.get("settings", {})
    if "teacher" in settings:
        settings = {**settings, "teacher": Path(settings["teacher"]).name}
    changed = {"resumed_from": Path(resumed).name if resumed else None, "env_kwargs": kwargs, "settings": settings}
    return record | changed


def write_card(
    run: str | Path,
    out: Path | None,
    ship: bool,
    task: str | None,
    episodes: int,
    sim2sim_episodes: int,
    levels: Sequence[str],
    env: str | None,
    env_args: Iterable[tuple[str, Any]],
    threads: int | None = None,
) -> tuple[Path, dict[str, Any]]:
    """Evaluate a policy, write `card.md`, `curve.png` and `policy.npz`, and return the card's path and the results.

    The files are written to `out`, to the folder of shipped policies if `ship` is true, and to the folder of the policy
    otherwise, where an existing `policy.npz` stays as it is. For `task`, see `short_name`; for `episodes`,
    `sim2sim_episodes` and `levels`, `card_results`; for `env`, `env_args` and `threads`, `evaluation.load`.

    Raises:
        PolicyError: If the policy cannot be used.
    """
    source = locate_policy(run)
    actor, record = read_actor(source)
    evaluated = load(source, env, env_args=env_args, threads=threads)
    if missing := [key for key in OF_TRAINING if key not in record]:
        raise PolicyError(f"{source}: {missing[0]}: missing; expected a policy that `python -m ce_gym train` wrote")
    record, curve = portable(record), read_curve(source.parent / LOG)
    name = short_name(record, task)
    folder = shelf() / name if ship else out or source.parent
    if folder.resolve().is_relative_to(shelf().resolve()) and not ship:
        raise PolicyError(f"{run}: is a policy of the package; expected --out FOLDER")
    policy = folder / "policy.npz"
    for file, kind in ((folder / "card.md", CARD), (folder / "curve.png", PICTURE)):
        check_output(file, kind)
    result = card_results(Policy(actor, evaluated.record), episodes, sim2sim_episodes, levels)
    folder.mkdir(parents=True, exist_ok=True)
    if policy.resolve() != source.resolve():
        write_npz(actor, record, policy)
    keep_map(evaluated.record["env_kwargs"], folder)
    if curve:
        draw_curve(curve, name, folder / "curve.png")
    write_file(folder / "card.md", card(record, result, curve, name), CARD)
    return folder / "card.md", result
