"""One page for each robot and task, in the manner of Gymnasium's own pages. May know the public environments' parts."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import Field, fields
from typing import Any

import gymnasium

from ce_gym.dynamics.forces.scene import SceneOptions
from ce_gym.envs.registration import camel_case
from ce_gym.envs.runtime.program import TaskProgram
from ce_gym.envs.runtime.setup import make_program
from ce_gym.envs.runtime.stages import OBSERVATION_BOUND
from ce_gym.envs.task.tasks import STARTS, Task
from ce_gym.envs.terms.registry import OWN
from ce_gym.model.mechanism import ELASTIC, LEVELS

GOALS = {
    "velocity": "Follow a commanded forward, sideways and turning velocity, which changes every few seconds.",
    "run": "Move forward as fast as it pays. `info` has the keys of Gymnasium's MuJoCo environments.",
    "stand": "Stand still while the base is pushed every two seconds.",
    "jump": "Be as high as possible in the second half of every second.",
    "high_jump": "Jump as high as possible from standing, once, and stand again.",
    "long_jump": "Fly as far as possible from standing, and stand again.",
    "land": "Land from a metre above the standing height, and stand.",
    "hop": "Hop on the first foot by a clock; no other foot may touch the ground after half a second.",
    "recover": "Get up and stand, from any orientation.",
    "backflip": "Turn backwards once in the air, and stand again.",
}
FIRST = {
    "transmission": (
        '"exact"',
        '`"exact"`, `"coupled"`, `"armature"`, `"none"` or `"elastic"`: what is kept of drives.',
    ),
    "rewards": ("{}", "Weights, or weights and parameters, that replace or add to those below; 0 removes a term."),
    "obs_mode": ('"vector"', '`"vector"`, or `"dict"` for `{"policy": ..., "critic": ...}`.'),
    "dtype": ('"float64"', '`"float64"` or `"float32"` for physics.'),
    "num_threads": ("None", "Threads; the number of usable cores if None."),
    "render_mode": ("None", 'None, `"rgb_array"` or `"human"`.'),
}
"""Arguments that are not attributes of a task: default and meaning."""

CAPITALS = {"mit": "MIT", "jvrc1": "JVRC-1", "anymal": "ANYmal"}


def environment_page(robot: str, task: str, drawn: bool) -> str:
    """Return the page of one robot and task, as Markdown; with the robot's picture if that has been drawn."""
    program, name = make_program(robot, task), camel_case(robot) + camel_case(task)
    parts = [
        f"# {title(robot)} {task}",
        GOALS.get(task, ""),
        f"![{title(robot)}](../robots/{robot}.png)" if drawn else "",
        table(("", ""), _facts(program, robot, name)),
        "## Action space",
        _actions(program),
        "## Observation space",
        _observations(program),
        "## Rewards",
        _rewards(program.task),
        "## Starting state",
        _start(program),
        "## Episode end",
        _end(program),
        "## Info",
        _info(program),
        "## Arguments",
        "Given to `gymnasium.make` or `gymnasium.make_vec`; the defaults are those of this environment.",
        table(("argument", "default", "meaning"), _arguments(program.task)),
        "## Version history",
        "`v0`: first version.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def title(robot: str) -> str:
    """Return `mini_cheetah` as `Mini Cheetah`, abbreviations in capitals."""
    return " ".join(CAPITALS.get(word, word.capitalize()) for word in robot.split("_"))


def _facts(program: TaskProgram, robot: str, name: str) -> list[tuple[str, str]]:
    n, m, bound = program.n_actions, program.observation_size, OBSERVATION_BOUND
    task, step = program.task, program.control_dt
    known = (*LEVELS, *([ELASTIC] if program.model.robot.elastic else []))
    levels = ", ".join(f'`"{level}"`' for level in known)
    threshold = gymnasium.spec(f"ce_gym/{name}-v0").reward_threshold
    robot_link = f"[{title(robot)}](../robots/{robot}.md)"
    return [
        ("**Robot**", robot_link),
        ("**Action space**", f"`Box(-1.0, 1.0, ({n},), float32)`"),
        ("**Observation space**", f"`Box({-bound}, {bound}, ({m},), float32)`"),
        ("**Import**", f'`gymnasium.make("ce_gym/{name}-v0")` after `gymnasium.register_envs(ce_gym)`'),
        ("**Control step**", f"{step:g} s: {task.n_substeps} sub-steps of {1e3 * task.dt:g} ms"),
        ("**Episode**", f"{task.episode_length} control steps, {task.episode_length * step:g} s"),
        ("**Reward threshold**", f"{threshold:g}"),
        ("**Ids**", f"`ce_gym/{name}-v0`, `ce_gym/{name}-Armature-v0`"),
        ("**Levels**", f"argument `transmission`: {levels}"),
    ]


def _actions(program: TaskProgram) -> str:
    robot, task, actions = program.model.robot, program.task, program.actions
    rows = []
    for k, i in enumerate(actions.moved):
        joint, rest, scale = actions.targets[i], actions.rest[i], actions.scale[k]
        limits, (low, high) = robot.body(joint).joint, (f"{rest + sign * scale:.3g}" for sign in (-1, 1))
        rows.append((k, f"target of `{joint}`", -1, 1, low, high, _limits(limits.position), "rad"))
    held = [f"`{n}`" for i, n in enumerate(actions.targets) if i not in actions.moved]
    said = (
        f"A joint's target is its standing angle plus `action_scale` = {task.action_scale:g} rad times the action, "
        "reached for by the robot's PD gains in every sub-step. "
        '`actions="joint_torque"` makes the action a share of the joint\'s largest torque instead; `"motor_pd"` and '
        '`"motor_torque"` speak to the motors.'
    )
    said += f" Joints without an action hold the standing pose: {', '.join(held)}." if held else ""
    columns = ("Num", "Action", "Min", "Max", "Target at min", "at max", "Joint range", "Unit")
    return f"{said}\n\n{table(columns, rows)}"


def _limits(pair: tuple[float, float]) -> str:
    return f"{pair[0]:.3g}\u00a0to\u00a0{pair[1]:.3g}" if all(map(math.isfinite, pair)) else "none"


def _observations(program: TaskProgram) -> str:
    rows, start = [], 0
    for name, size in program.observation_sizes.items():
        meaning, unit = _meaning("observation", name)
        place = f"{start}\u00a0to\u00a0{start + size - 1}" if size > 1 else str(start)
        rows.append((place, f"`{name}`", size, -OBSERVATION_BOUND, OBSERVATION_BOUND, meaning, unit))
        start += size
    said = "Blocks one after another, scaled to order one and clipped; `env.unwrapped.observation_structure` has them."
    return f"{said}\n\n{table(('Num', 'Block', 'Size', 'Min', 'Max', 'Meaning', 'Unit before scaling'), rows)}"


def _rewards(task: Task) -> str:
    weights = {name: own["weight"] if isinstance(own, Mapping) else own for name, own in task.rewards.items()}
    rows = [(f"`{name}`", f"{weight:g}", *_meaning("reward", name)) for name, weight in weights.items()]
    said = "The sum over terms of weight times term times control step"
    said += "; a negative sum counts as zero, unless `only_positive=False`." if task.only_positive else "."
    return f"{said}\n\n{table(('Term', 'Weight', 'Meaning', 'Unit'), rows)}"


def _start(program: TaskProgram) -> str:
    noise, height = program.task.reset_noise, program.model.robot.pose.height
    angle, speed, base = (noise[key] for key in ("joint_position", "joint_velocity", "base_velocity"))
    start = "".join(f" Then, {STARTS[k]}: {low:.3g} to {high:.3g}." for k, (low, high) in program.task.start.items())
    return (
        f"Upright in the standing pose, the base {height:.3g} m high, every joint off by up to {angle:g} rad, joint "
        f"velocities up to {speed:g} rad/s, base velocities up to {base:g} rad/s and m/s, all drawn uniformly.{start}"
    )


def _end(program: TaskProgram) -> str:
    rows = [f"- `{name}`: {_meaning('termination', name)[0]}" for name in program.task.terminations] or ["- nothing"]
    return "\n".join(
        [
            "Terminated, as a failure, when one of these holds at the end of a control step:",
            "",
            *rows,
            "",
            f"Truncated after {program.task.episode_length} control steps, or when the simulation has failed "
            '(`info["diverged"]`, at the last good state).',
        ]
    )


def _info(program: TaskProgram) -> str:
    rows = [(f"`{name}`", *_meaning("metric", name)) for name in program.task.metrics]
    said = (
        "Every step: `diverged`, each weighted reward term as `reward_<term>`, and position and velocity of the base. "
        'A vector environment has the terms in `infos["reward_terms"]` and, where an episode has ended, its length, '
        'sums and the means of these in `infos["episode_terms"]`:'
    )
    return f"{said}\n\n{table(('Metric', 'Meaning', 'Unit'), rows)}"


def _arguments(task: Task) -> Iterable[tuple[str, str, str]]:
    for name, (default, meaning) in FIRST.items():
        yield f"`{name}`", f"`{default}`", meaning
    for field, meaning in task_fields():
        if field.name not in ("rewards", "metrics"):
            yield f"`{field.name}`", f"`{plain(getattr(task, field.name))}`", meaning


def task_fields() -> Iterator[tuple[Field, str]]:
    """Yield each field of tasks with its meaning, scene options last."""
    meanings = attributes_of(inspect.getdoc(SceneOptions) or "") | attributes_of(inspect.getdoc(Task) or "")
    of_scene = {field.name for field in fields(SceneOptions)}
    for field in sorted(fields(Task), key=lambda field: field.name in of_scene):
        yield field, meanings[field.name]


def plain(value: Any) -> str:
    """Return a value as a user would write it."""
    if hasattr(value, "items"):
        return "{" + ", ".join(f'"{k}": {plain(v)}' for k, v in value.items()) + "}"
    if isinstance(value, tuple):
        return "[" + ", ".join(plain(item) for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else str(value)


def attributes_of(docstring: str) -> dict[str, str]:
    """Return the entries of the section "Attributes" of a cleaned docstring, by name; none without such a section."""
    if "Attributes:\n" not in docstring:
        return {}
    section = docstring.split("Attributes:\n")[1].split("\n\n")[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n        .*)*)", section, re.MULTILINE)
    return {name: " ".join(meaning.split()) for name, meaning in entries}


def _meaning(kind: str, name: str) -> tuple[str, str]:
    """Return the first sentence of a term's docstring, without its units, and those."""
    function: Callable = OWN[kind][name]
    text = " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())
    units = re.findall(r"\[([^\]]+)\]", text)
    plain = re.sub(r" ?\[[^\]]+\]", "", re.sub(r", shape \([^)]*\)", "", text))
    return plain, ", ".join(dict.fromkeys(units)) or "-"


def percent(x: float) -> str:
    """Return a share as text with three digits."""
    return f"{100 * x:.0f}\u00a0%" if x >= 1 else f"{100 * x:.3g}\u00a0%"


def table(columns: tuple[str, ...], rows: Iterable[tuple[Any, ...]]) -> str:
    """Return a table in Markdown."""
    lines = [" | ".join(columns), " | ".join("---" for _ in columns)]
    lines += [" | ".join(str(cell).replace("|", "\\|") for cell in row) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)
