"""Robot files changed at random: values, keys, elements and branches of the four formats replaced, moved, removed.

A robot that is accepted must have a positive definite mass matrix, and forward dynamics that inverse dynamics takes
back.
"""

from __future__ import annotations

import copy
import random
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from ce_gym.dynamics.model import Model
from ce_gym.export.mjcf import to_mjcf
from ce_gym.model import RobotError, assets_folder, load_robot

VALUES: tuple[Any, ...] = (
    *(0, -1, 1e-300, 1e10, 1e308, float("nan"), float("inf"), True, None, "", "world", "\x1b[31m", "x" * 300),
    *([], [1, 2], {}, {"a": 1}, 10**400),
)
LOOP = """<loop name="pin" type="revolute"><predecessor link="link2"><origin xyz="1 0 0"/></predecessor>
<successor link="link3"><origin xyz="0.5 0 0"/></successor><axis xyz="0 0 1"/></loop></robot>"""
SOUND, REFUSED = "sound robot", "refused in one line"


def case(seed: int, folder: Path) -> tuple[str, str]:
    """Write the files of one case and load them; returns the format and the outcome."""
    rng = random.Random(seed)
    kind = rng.choice(tuple(FORMATS))
    path = FORMATS[kind](rng, folder)
    return kind, outcome_of(path)


def outcome_of(path: Path) -> str:
    """Load a robot and check its dynamics."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = Model(load_robot(path))
            v, tau = np.zeros(model.nv), np.ones(model.nv)
            vdot = model.forward_dynamics(model.standing_q, v, tau)
            again, M = model.inverse_dynamics(model.standing_q, v, vdot), model.mass_matrix(model.standing_q)
    except RobotError as error:
        return REFUSED if str(error).isprintable() and len(str(error)) < 1000 else f"message {str(error)[:200]!r}"
    except Exception as error:  # a fuzzer wants to know of everything
        return f"{type(error).__name__}: {str(error)[:200]}"
    scale = np.sqrt(np.abs(np.diag(M)))
    size = 1.0 + np.abs(model.bias_force(model.standing_q, v)).max()
    if not np.isfinite(vdot).all() or not np.linalg.eigvalsh(M / scale / scale[:, None])[0] > 0.0:
        return "nonsense: mass matrix or acceleration"
    return SOUND if np.abs(again - tau).max() < 1e-3 * size else "nonsense: forces do not come back"


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Iterate over all containers of nested lists and dictionaries, with each of their keys."""
    keys = tree.keys() if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys:
        yield tree, key
        yield from _places(tree[key])


def _yaml(rng: random.Random, folder: Path) -> Path:
    name = rng.choice(("four_bar", "mit_humanoid_leg", "planar_leg_linkage"))
    data = yaml.safe_load((assets_folder() / name / f"{name}.yaml").read_text())
    for _ in range(rng.choice((1, 1, 2, 3))):
        container, key = rng.choice(list(_places(data)))
        other, its = rng.choice(list(_places(data)))
        old, new = container[key], copy.deepcopy(rng.choice((*VALUES, other[its])))
        if isinstance(old, float) and rng.random() < 0.5:
            new = old * rng.choice((-1, 10, 0.1, 1e3, 1e6, 1e12))
        if rng.random() < 0.2:
            del container[key]
        elif isinstance(container, dict) and rng.random() < 0.2:
            container[str(rng.choice((its, key, f"{key}_")))] = container.pop(key)
        else:
            container[key] = new
    (folder / f"{name}.urdf").write_bytes((assets_folder() / name / f"{name}.urdf").read_bytes())
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def _changed_xml(rng: random.Random, text: str) -> str:
    root = ElementTree.fromstring(text)
    for _ in range(rng.choice((1, 1, 2, 3))):
        elements = list(root.iter())
        element, other = rng.choice(elements), rng.choice(elements)
        parent = next((p for p in elements if element in list(p)), None)
        what = rng.random()
        if what < 0.6 and element.attrib:
            key = rng.choice(list(element.attrib))
            words = [str(rng.choice((*VALUES, *other.attrib.values()))), f"{rng.uniform(-9, 9)}", element.get(key, "")]
            chosen = rng.sample(words, rng.choice((1, 1, 2)))
            element.set(key, " ".join(word if word.isprintable() else "\x85" for word in chosen))
        elif parent is not None and what < 0.75:
            parent.remove(element)
        elif parent is not None and what < 0.9:
            parent.append(copy.deepcopy(element))
        else:
            element.append(copy.deepcopy(other))
    return ElementTree.tostring(root, encoding="unicode")


def _xml(suffix: str, text: Callable[[random.Random], str]) -> Callable[[random.Random, Path], Path]:
    def write(rng: random.Random, folder: Path) -> Path:
        path = folder / f"changed{suffix}"
        path.write_text(_changed_xml(rng, text(rng)), encoding="utf-8")
        return path

    return write


def _urdf(rng: random.Random) -> str:
    name = rng.choice(("mit_humanoid_leg", "planar_leg_linkage", "four_bar"))
    return (assets_folder() / name / f"{name}.urdf").read_text()


def _urdf_plus(rng: random.Random) -> str:
    text = (assets_folder() / "four_bar" / "four_bar.urdf").read_text().replace("</robot>", LOOP)
    for link in ("link2", "link3"):
        at = text.rindex("<joint", 0, text.index(f'<child link="{link}"'))
        text = f'{text[:at]}<joint independent="false"{text[at + 6 :]}'
    return text


def _mjcf(rng: random.Random) -> str:
    return to_mjcf(load_robot(rng.choice(("mit_humanoid_leg", "planar_leg_linkage", "four_bar"))))


FORMATS: dict[str, Callable[[random.Random, Path], Path]] = {
    "YAML": _yaml,
    "URDF": _xml(".urdf", _urdf),
    "URDF+": _xml(".urdf", _urdf_plus),
    "MJCF": _xml(".xml", _mjcf),
}
