"""Write the card of a trained policy: what it is, how it was trained, how good it is, how to repeat it.

From the folder of a training run: `card.md`, `curve.png` and `policy.npz`, the actor's weights and the record, small
and safe to open. With `--ship` they go where shipped policies lie, under `<robot>_<task>_<level>`, the short name by
which the other programs find it. Uses public names of ce_gym only, and no name of a robot or task.

    python train/card.py runs/mini_cheetah_velocity
    python train/card.py runs/mini_cheetah_velocity --ship
"""

from __future__ import annotations

import interruption  # noqa: F401
import single_blas  # noqa: F401

# isort: split

import argparse
import importlib
import json
import math
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
from console import EPISODES, Parser, Table, add_json_argument, markdown, print_result, run, whole
from crossing import cross, crossing_table
from effort import effort
from evaluate import evaluate, own_figures
from pictures import draw_curve
from progress import read_curve
from pushes import direction_name, push_envelope
from settings import Settings, config_file, load_settings
from suites import judge_suites, level_table, suite_table, weights_seed

from ce_gym import LEVELS
from ce_gym.policies import (
    Policy,
    PolicyError,
    add_env_arguments,
    environment_of,
    keep_map,
    locate_policy,
    read_actor,
    shelf,
    write_npz,
)

OWN_SETTINGS = ("shac", "distill")
"""Learners that have other settings than PPO."""

FINER = 5
"""Sub-steps are that much shorter in one judgement: a policy may live on their length."""


def judged(policy: Policy, episodes: int, sim2sim_robots: int, levels: Sequence[str] = LEVELS) -> dict[str, Any]:
    """Judge a policy for its card.

    Args:
        policy: With its record.
        episodes: Episodes on each level, and of each suite.
        sim2sim_robots: Robots in MuJoCo; 0 leaves that out.
        levels: Levels besides that of training.

    Returns:
        seed: of everything, that which the weights give; levels: result of `evaluate` by level; finer: the same on the
        level of training with sub-steps `FINER` times shorter; suites, effort and pushes, on the level of training;
        crossing, where the ground has levels, see `crossing.cross`; sim2sim, or
        sim2sim_missing, one line that says why there is none. Of a policy that sees no commands there are no suites,
        crossing, pushes and sim2sim.
    """
    record, kwargs, seed = policy.record, policy.record["env_kwargs"], weights_seed(policy)
    found = {
        level: evaluate(policy, record["env"], episodes=episodes, seed=seed, **{**kwargs, "transmission": level})
        for level in dict.fromkeys((*levels, record["transmission"]))
    }
    longest = gymnasium.spec(record["env"]).max_episode_steps or math.inf
    seconds = min(10.0, longest * record["policy_spec"]["control_dt"])
    result: dict[str, Any] = {"seed": seed, "levels": found}
    shorter = {**kwargs, **_shorter(record["policy_spec"])}
    result["finer"] = evaluate(policy, record["env"], episodes=episodes, seed=seed, **shorter)
    result["effort"] = effort(policy, seconds=seconds, seed=seed, **kwargs)
    if not found[record["transmission"]]["commanded"]:
        return result | {"sim2sim_missing": "it sees no commands, by which simulations are compared"}
    result["suites"] = judge_suites(policy, episodes, seed, **kwargs)
    result["pushes"] = push_envelope(policy, seed=seed, **kwargs)
    if found[record["transmission"]].get("levels"):
        result["crossing"] = cross(policy, episodes, seed, **kwargs)
    if not sim2sim_robots:
        return result | {"sim2sim_missing": "not asked for"}
    try:
        from sim2sim import compare

        return result | {"sim2sim": compare(policy, episodes=sim2sim_robots, seed=seed)}
    except ImportError:
        return result | {"sim2sim_missing": "MuJoCo is not installed: pip install ce_gym[mjcf]"}
    except ValueError as error:  # MuJoCo cannot express every robot
        why = " ".join(str(error).split()).replace(f"{shelf().parent}/", "")  # cards travel, folders do not
        return result | {"sim2sim_missing": why}


def _shorter(spec: dict[str, Any]) -> dict[str, Any]:
    """Arguments of an environment whose control steps are as long, of `FINER` times as many sub-steps."""
    dt = spec["physics_dt"] / FINER
    return {"dt": dt, "n_substeps": round(spec["control_dt"] / dt)}


def command(record: dict[str, Any]) -> str:
    """Return the command line that repeats a training run.

    Raises:
        PolicyError: If none can, because the policy goes on from another one.
    """
    if record["resumed_from"]:
        raise PolicyError(f"resumed from {record['resumed_from']}; expected a run from the beginning")
    words = [
        "python",
        f"train/{record.get('learner', 'ppo')}.py",
        "--env",
        record["env"],
        "--seed",
        str(record["seed"]),
    ]
    kwargs = dict(record["env_kwargs"])
    if level := kwargs.pop("transmission", None):
        words += ["--transmission", level]
    if isinstance(kwargs.get("critic"), list) and kwargs.pop("obs_mode", None) == "dict":
        words += ["--critic", *kwargs.pop("critic")]
    for key, value in kwargs.items():
        words += ["--env-arg", f"{key}={json.dumps(value)}"]
    kind = _settings_of(record)
    usual = json.loads(json.dumps(asdict(load_settings(config_file(record["env"], kind.folder), kind=kind))))
    chosen = record["settings"] | {"steps": min(record["settings"]["steps"], record["steps"])}  # a deadline may end it
    changed = {key: value for key, value in chosen.items() if value != usual[key]}
    texts = {key: json.dumps(value) if isinstance(value, dict) else value for key, value in changed.items()}
    words += ["--set", *(f"{key}={text}" for key, text in texts.items())] if texts else []
    return shlex.join(words)


def _settings_of(record: dict[str, Any]) -> type:
    """The dataclass of the settings of the learner that a record names."""
    if (name := record.get("learner")) not in OWN_SETTINGS:
        return Settings
    return importlib.import_module(name).Settings  # says what is missing where its extra is not installed


def card(record: dict[str, Any], result: dict[str, Any], curve: list[dict[str, float]], name: str) -> str:
    """Return the card as Markdown.

    Args:
        record: Of the policy.
        result: As `judged` returns it.
        curve: Rows of the learning curve.
        name: Of the policy.
    """
    versions = ", ".join(f"{package} {number}" for package, number in record["versions"].items())
    seconds = max([record["training_seconds"], *(row["seconds"] for row in curve)])
    facts: Table = [
        ["what", ""],
        ["environment", f"`{record['env']}`"],
        ["trained on", f"`{record['transmission']}` transmissions"],
        ["seed", str(record["seed"])],
        ["steps", f"{record['steps']:,}"],
        ["wall-clock time", f"{seconds:.0f} s"],
        *([["processor time", f"{spent:.0f} s"]] if (spent := record.get("processor_seconds")) else []),
        ["observation, action", f"{record['observation_size']} numbers, {record['action_size']} numbers"],
        ["date", record["date"]],
        ["versions", versions],
    ]
    settings: Table = [["setting", "value"], *([key, str(value)] for key, value in record["settings"].items())]
    parts = [
        f"# {name}",
        f"{markdown(facts)}\n\n{_how_to_repeat(record)}",
        *(["![Learning curve](curve.png)"] if curve else []),
        f"## On transmission levels\n\n{_levels(record, result)}",
        *_on_terrain(record, result["levels"]),
        *_crossing(result),
        *_asked_for(result),
        *([f"## Motors\n\n{_motors(result['effort'])}"] if result["effort"] else []),
        *([f"## Pushes\n\n{_pushes(result['pushes'])}"] if "pushes" in result else []),
        f"## In MuJoCo\n\n{_sim2sim(result)}",
        f"## Settings\n\n{markdown(settings)}",
    ]
    return "\n\n".join(parts) + "\n"


def _how_to_repeat(record: dict[str, Any]) -> str:
    try:
        return f"Trained by\n\n```sh\n{command(record)}\n```"
    except PolicyError as error:
        return f"No single command repeats it: {error}"


def _levels(record: dict[str, Any], result: dict[str, Any]) -> str:
    level, spec = record["transmission"], record["policy_spec"]
    found = {f"`{name}`" + " (trained)" * (name == level): each for name, each in result["levels"].items()}
    found[f"`{level}`, sub-steps of {1e3 * _shorter(spec)['dt']:g} ms"] = result["finer"]
    rows: Table = []
    for name, figures in found.items():
        shown = _errors(figures) if figures["commanded"] else own_figures(figures)
        rows = rows or [["judged on", *shown, "falls", "reward"]]
        last = (f"{figures['falls']:.1%}", f"{figures['reward']:.2f}")
        rows.append([name, *(f"{figure:.3f}" for figure in shown.values()), *last])
    count, length = figures["episodes"], spec["control_dt"]
    said = "Mean absolute errors over every step" if figures["commanded"] else "Means, in SI units,"
    said = f"{said} of {count} episodes of the mean action; a step is {length:g} s"
    said = f"{said}, of sub-steps of {spec['physics_dt'] * 1e3:g} ms."
    return f"{markdown(rows)}\n\n{said} Seed {result['seed']}: the first 32 bits of the SHA-256 of the weights."


def _errors(figures: dict[str, Any]) -> dict[str, float]:
    titles = {"forward [m/s]": "forward_error", "sideways [m/s]": "lateral_error", "yaw rate [rad/s]": "yaw_rate_error"}
    return {title: figures[key] for title, key in titles.items()}


def _asked_for(result: dict[str, Any]) -> list[str]:
    """The section on suites of commands, if there are some."""
    table = f"{suite_table(result['suites'])}\n\nOn the level of training." if "suites" in result else ""
    return [f"## By what is asked for\n\n{table}"] if table else []


def _on_terrain(record: dict[str, Any], levels: dict[str, dict[str, Any]]) -> list[str]:
    """The section on the levels of the ground, if it has some."""
    found = levels.get(record["transmission"], {}).get("levels")
    return [f"## On every level of the ground\n\n{level_table(found)}"] if found else []


def _crossing(result: dict[str, Any]) -> list[str]:
    """The section on who crosses the ground, if that was judged."""
    said = "Robots that walk straight ahead, by the mean action, and get there without a fall; see `train/crossing.py`."
    table = crossing_table(result["crossing"]) if "crossing" in result else ""
    return [f"## Across the ground\n\n{table}\n\n{said}"] if table else []


def _motors(found: dict[str, Any]) -> str:
    rows: Table = [["", ""], ["mean speed", f"{found['speed']:.2f} m/s"], ["power", f"{found['power']:.0f} W"]]
    if found["cost_of_transport"] is not None:
        rows.append(["cost of transport", f"{found['cost_of_transport']:.2f}"])
        rows.append(["the same, braking recovered", f"{found['cost_of_transport_net']:.2f}"])
    for what in ("torque", "power"):
        if found[f"mean_{what}"] is not None:
            peak = f"{found[f'peak_{what}']:.0%} of its limit (`{found[f'peak_{what}_at']}`)"
            rows += [[f"mean {what} of a motor", f"{found[f'mean_{what}']:.0%} of its limit"], [f"peak {what}", peak]]
    return f"{markdown(rows)}\n\nMechanical, at the rotors, every sub-step counted."


def _pushes(found: dict[str, Any]) -> str:
    rows: Table = [["pushed towards", *(f"{speed:g} m/s" for speed in found["speeds"])]]
    for angle, row in zip(found["directions"], found["survived"], strict=True):
        rows.append([direction_name(angle), *(f"{share:.0%}" for share in row)])
    walking = f"{found['command'][0]:g} m/s forward"
    return f"{markdown(rows)}\n\nShare on its feet after a sudden change of velocity, at {walking}."


def _sim2sim(result: dict[str, Any]) -> str:
    if "sim2sim" not in result:
        return f"Not judged: {result['sim2sim_missing']}"
    rows: Table = [["simulated by", "velocity error [m/s]", "yaw rate error [rad/s]", "falls", "verdict"]]
    for name, figures in result["sim2sim"]["simulations"].items():
        verdict = result["sim2sim"]["verdict"].get(name)
        said = "" if verdict is None else "passed" if verdict["passed"] else "failed"
        errors = [f"{figures[key]:.3f}" for key in ("velocity_error", "yaw_rate_error")]
        rows.append([name, *errors, f"{figures['falls']:.1%}", said])
    return f"{markdown(rows)}\n\nRandom commands, one for each robot; `python train/sim2sim.py` says what is asked for."


def short_name(record: dict[str, Any], task: str | None = None) -> str:
    """The name under which a policy is shipped; `task` stands there instead of the name of its task.

    Raises:
        PolicyError: If the record says nothing that can be the name of a folder.
    """
    spec = record["policy_spec"]
    name = "_".join(str(x) for x in (spec.get("robot"), task or spec.get("task"), record["transmission"]))
    if not re.fullmatch(r"[\w-]+", name):
        raise PolicyError(f"policy_spec: robot, task and level {name!r}; expected letters, digits, _ and - only")
    return name


def portable(record: dict[str, Any]) -> dict[str, Any]:
    """A record without paths of the machine it was written on."""
    resumed, kwargs = record.get("resumed_from"), dict(record["env_kwargs"])
    terrain = kwargs.get("terrain")
    if isinstance(terrain, Mapping) and "file" in terrain:  # a copy lies beside the policy
        kwargs["terrain"] = {**terrain, "file": Path(terrain["file"]).name}
    own: dict[str, Any] = {"resumed_from": Path(resumed).name if resumed else None, "env_kwargs": kwargs}
    settings = record.get("settings", {})
    if "teacher" in settings:
        own["settings"] = {**settings, "teacher": Path(settings["teacher"]).name}
    return record | own


def main(argv: list[str] | None = None) -> int:
    """Command line of this file."""
    parser = Parser(
        description="Judge the policy of a training run and write its card, its learning curve and policy.npz."
    )
    parser.add_argument("run", help="folder of a training run, or the policy in it")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--out", type=Path, metavar="FOLDER", help="where to write (default: the run's folder)")
    where.add_argument("--ship", action="store_true", help="write to assets/policies/<robot>_<task>_<level>")
    parser.add_argument("--task", metavar="NAME", help="in the policy's name, such as stairs (default: the task's)")
    parser.add_argument(
        "--episodes", type=EPISODES, default=2048, metavar="N", help="episodes on each level (default 2048)"
    )
    parser.add_argument(
        "--robots", type=whole(0, 100_000), default=50, metavar="N", help="robots in MuJoCo; 0: none (default 50)"
    )
    text = "levels to judge on besides that of training (default: all)"
    parser.add_argument("--levels", nargs="*", choices=LEVELS, default=LEVELS, metavar="LEVEL", help=text)
    add_env_arguments(parser)
    add_json_argument(parser)
    args = parser.parse_args(argv)
    return run("card.py", lambda: _work(args))


def _work(args: argparse.Namespace) -> int:
    """Judge, and write the three files."""
    source = locate_policy(args.run)
    actor, record = read_actor(source)
    record, curve = portable(record), read_curve(source.parent / "curve.csv")
    name = short_name(record, args.task)
    out = shelf() / name if args.ship else args.out or source.parent
    acted_in = {"env": environment_of(record, args.env), "env_kwargs": {**record["env_kwargs"], **dict(args.env_args)}}
    policy = Policy(actor, record | acted_in)
    result = judged(policy, args.episodes, args.robots, args.levels)
    out.mkdir(parents=True, exist_ok=True)
    write_npz(actor, record, out / "policy.npz")
    keep_map(record["env_kwargs"], out)
    if curve:
        draw_curve(curve, name, out / "curve.png")
    (out / "card.md").write_text(card(record, result, curve, name), encoding="utf-8")
    print_result(result, str(out / "card.md"), args.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
