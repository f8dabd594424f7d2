"""One page for each robot: a picture, its figures, its cluster tree drawn, its rotors and what each level gets wrong.

May know models, their reports and the viewer's pictures; knows no Sphinx.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from functools import cache
from pathlib import Path

import numpy as np
from drawing import tree_drawing
from environment_page import percent, table, title
from numpy.typing import NDArray

from ce_gym import InertiaWarning, Model, Robot, load_robot
from ce_gym.diagnostics.transmission import DROPPED, TransmissionReport, analyse_models
from ce_gym.envs.registration import ROBOTS, tasks_of
from ce_gym.model.formats.reading import read_yaml
from ce_gym.model.mechanism import LEVELS
from ce_gym.viewer import ViewerError

ROUNDING = 1e-12
"""Entries of reflected inertias smaller than this are zero [kg m^2]."""


@cache
def shipped(name: str) -> Robot:
    """Return a robot that ships with the package, without warnings; its notes contain them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InertiaWarning)
        return load_robot(name)


@cache
def models_of(name: str) -> dict[str, Model]:
    """Return a robot's model at each level, which trace what several pages count and evaluate once."""
    return {level: Model(shipped(name), level) for level in LEVELS}


@cache
def report_of(name: str) -> TransmissionReport:
    """Return the transmission report of a robot that ships with the package, as `python -m ce_gym inspect` has it."""
    return analyse_models(models_of(name))


def robot_page(name: str, folder: Path) -> str:
    """Return the page of one robot as Markdown, and write its picture into the folder."""
    robot, report = shipped(name), report_of(name)
    model = models_of(name)["exact"]
    parts = [
        f"# {title(name)}",
        picture(model, folder / f"{name}.png", folder),
        table(("", ""), _facts(robot, model)),
        _environments(name),
        "## Cluster tree",
        "Filled: an independent joint. Hollow: one that a constraint ties to others. Dashed: a rotor, with its gear "
        "ratio for each joint that turns it. A box is a cluster; it moves as one joint of the recursion.",
        f"```{{raw}} html\n{tree_drawing(robot)}\n```",
        *_transmissions(report),
        "## Sources and notes",
        _sources(robot),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _facts(robot: Robot, model: Model) -> list[tuple[str, str]]:
    rotors = list(robot.rotors())
    eliminated = sum(map(len, model.mechanism.eliminated_rotors))
    return [
        ("**Base**", "floating" if robot.floating else "fixed"),
        ("**Mass**", f"{robot.total_mass:.3f} kg"),
        ("**Bodies**", f"{len(robot.bodies)}, of which {len(rotors)} rotors"),
        ("**Independent joints**", str(len(robot.independent))),
        ("**Clusters**", str(len(model.cluster_tree.clusters))),
        ("**Rotors that need no body**", f"{eliminated} of {len(rotors)}"),
        ("**Forward dynamics, exact**", f"{model.n_instructions('forward_dynamics')} scalar operations"),
        ("**Load it**", f'`ce_gym.load_robot("{robot.name}")`'),
    ]


def _environments(name: str) -> str:
    if name not in ROBOTS:
        return ""
    links = [f"[{task.replace('_', ' ')}](../environments/{name}_{task}.md)" for task in tasks_of(name)]
    pages = "\n".join(f"../environments/{name}_{task}" for task in tasks_of(name))
    return f"Environments: {', '.join(links)}.\n\n```{{toctree}}\n:hidden:\n\n{pages}\n```"


def _transmissions(report: TransmissionReport) -> list[str]:
    """Return the sections on rotors and levels; none for a robot without rotors."""
    if not report.clusters:
        return ["It has no rotors, so all transmission levels are the same."]
    rows = []
    for cluster in report.clusters:
        for joint, row, share in zip(cluster.joints, cluster.reflected, cluster.share, strict=True):
            turning = [r for r in cluster.rotors if joint in r.ratios]
            ratios = ", ".join(f"`{r.name}` {r.ratios[joint]:.4g}" for r in turning)
            reflected = ", ".join(f"{x if abs(x) > ROUNDING else 0:.4g}" for x in row)
            rows.append((f"`{joint}`", ratios, reflected, percent(share)))
    columns = (
        "joint",
        "rotors and their ratios",
        "row of the reflected inertia [kg m²]",
        "share of the joint's inertia",
    )
    parts = ["## Rotors", table(columns, rows)]
    if report.errors:
        floating = report.errors[0].base is not None
        levels = [
            (
                f"`{e.level}`",
                DROPPED[e.level],
                *(percent(x) for s in (e.joints, e.base) if s for x in (s.median, s.max)),
            )
            for e in report.errors
        ]
        columns = ("level", "drops", "joints, median", "largest", *(("base, median", "largest") if floating else ()))
        said = (
            f"Error of the acceleration, relative to the exact one, over {report.states} random states around the "
            "standing pose, as `python -m ce_gym inspect` finds it."
        )
        parts += ["## What each level gets wrong", said, table(columns, levels)]
    return parts


def _sources(robot: Robot) -> str:
    texts = [*read_yaml(Path(robot.source)).texts("sources"), *robot.notes]
    return "\n".join(f"- {text}" for text in texts)


def picture(model: Model, path: Path, page: Path, root: str = "") -> str:
    """Draw a robot in its standing pose, for a page in a folder; nothing if what draws is not installed.

    Args:
        model: The robot.
        path: The picture.
        page: The folder that links to the picture begin at.
        root: How they begin.
    """
    from ce_gym.viewer.raytrace.picture import Picture

    try:
        pixels = Picture(model, model.standing_q, width=640, height=400).draw(model.standing_q)
    except ViewerError:
        return ""
    path.write_bytes(png(np.asarray(pixels)))
    return f"![{title(model.robot.name)} in its standing pose]({root}{path.relative_to(page).as_posix()})"


def png(pixels: NDArray[np.uint8]) -> bytes:
    """Return a picture, shape (height, width, 3), as a PNG file."""
    height, width, _ = pixels.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), pixels.reshape(height, -1)], axis=1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IDAT", zlib.compress(rows.tobytes(), 9))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + body + chunk(b"IEND", b"")
