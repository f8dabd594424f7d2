"""Published figures of the package's robots, and what tests need to read them."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

FACTS = Path(__file__).resolve().parents[1] / "data" / "facts"
REPAIRED = {"jvrc1": "jvrc1_symmetric"}
"""File of a robot that carries the published figures with repairs."""


def read_facts(robot: str) -> dict[str, Any]:
    return yaml.safe_load((FACTS / f"{REPAIRED.get(robot, robot)}.yaml").read_text(encoding="utf-8"))


def rotation(rpy) -> np.ndarray:
    """An independent Rz Ry Rx."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


def above_ground(model) -> dict[str, float]:
    """How far each contact's lowest point is above the ground in the standing pose [m], by name."""
    centres = model.contact_points(model.standing_q, np.zeros(model.nv))[0]
    contacts = model.robot.contacts
    return {contact.name: z - contact.radius for contact, z in zip(contacts, centres[:, 2], strict=True)}


def feet_above_ground(model) -> tuple[float, float]:
    """The least and the most of that among the feet."""
    under = above_ground(model)
    feet = [under[contact.name] for contact in model.robot.contacts if contact.group == "foot"]
    return min(feet), max(feet)
