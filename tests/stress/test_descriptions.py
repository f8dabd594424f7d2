"""Descriptions made in Python with one wrong value: refused in one line, or a model with finite accelerations."""

import random
import time
import warnings
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from tripod import TRIPOD

from ce_gym.dynamics.model import Model
from ce_gym.model import Battery, Capsule, ContactMaterial, Frame, Heat, InertiaWarning, Robot, RobotError, load_robot
from ce_gym.model.description import Shape
from ce_gym.model.drives import DriveFriction, Elasticity
from ce_gym.sim import Simulator

VALUES: tuple[Any, ...] = (
    *(float("nan"), float("inf"), -float("inf"), -1.0, 0.0, 1e-300, 1e13, 1e300, 10**400, -(10**400)),
    *(
        None,
        True,
        "x",
        "",
        1j,
        (),
        (1.0,),
        (float("nan"),) * 3,
        [0.0],
        np.zeros(3),
        np.float32(2.0),
        np.datetime64("NaT"),
    ),
    *({}, object(), Heat, ContactMaterial()),
)
Path = tuple[str | int, ...]


def rich() -> Robot:
    """Return a robot that has a description of every kind."""
    robot = load_robot(TRIPOD)
    link = robot.bodies[0]
    body = replace(link, shapes=(*link.shapes, Shape("box", (0.1, 0.1, 0.1))))
    figures = {
        "motor_constant": 0.1,
        "heat": Heat(2.0, 20.0, 1.5, 3.0),
        "cogging": ((6, 0.02, 0.3),),
        "drive_friction": DriveFriction(stribeck=0.05, stribeck_speed=5.0, load_motor=0.1),
    }
    return replace(
        robot,
        bodies=(body, *robot.bodies[1:]),
        motors=tuple(replace(motor, **figures) for motor in robot.motors),
        elastic=tuple(Elasticity(rotor.name, 100.0, 0.1, preload=1.0) for rotor in robot.rotors()),
        battery=Battery(24.0, 0.1, 24.0),
        capsules=(Capsule(link.name, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 0.02),),
        frames=(Frame("imu", link.name),),
    )


def places(value: Any, path: Path = ()) -> Iterator[Path]:
    """Iterate over the places of all values in a description, `tasks` and texts for readers left out."""
    yield path
    if is_dataclass(value):
        named = [(f.name, getattr(value, f.name)) for f in fields(value) if f.name not in ("tasks", "notes", "source")]
    else:
        named = list(enumerate(value)) if isinstance(value, tuple) else []
    for name, part in named:
        yield from places(part, (*path, name))


def changed(description: Any, path: Path, value: Any) -> Any:
    """Return a description with another value at a place."""
    if not path:
        return value
    name, *rest = path
    if isinstance(name, str):
        return replace(description, **{name: changed(getattr(description, name), tuple(rest), value)})
    return (*description[:name], changed(description[name], tuple(rest), value), *description[name + 1 :])


def attack(robot: Robot, path: Path, value: Any) -> None:
    """Make a model of a robot with a wrong value.

    Raises:
        AssertionError: The value is neither refused in one line nor harmless.
    """
    wrong = changed(robot, path, value)
    try:
        model = Model(wrong, "elastic" if path[0] == "elastic" else "exact")
    except RobotError as error:
        if "\n" in str(error):
            raise AssertionError(f"{path}: several lines: {error}") from error
        return
    acceleration = model.forward_dynamics(model.standing_q, np.zeros(model.nv), np.zeros(model.nv))
    assert np.isfinite(acceleration).all(), f"{path} = {value!r}"


def attack_at_random(rng: random.Random, robot: Robot, known: list[Path]) -> None:
    """Attack at a random place with a random value."""
    path, value = rng.choice(known), rng.choice(VALUES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InertiaWarning)
        try:
            attack(robot, path, value)
        except AssertionError:
            raise
        except Exception as error:
            raise AssertionError(f"{path} = {value!r}: {type(error).__name__}: {error}") from error


def test_wrong_values_of_descriptions_are_refused_or_harmless():
    robot, rng = rich(), random.Random(0)
    Model(robot, "elastic")
    known = [path for path in places(robot) if path]
    assert len(known) > 300
    for _ in range(250):
        attack_at_random(rng, robot, known)


@pytest.mark.parametrize("field", [f.name for f in fields(ContactMaterial)])
def test_wrong_materials_are_refused(field: str):
    model = Model(TRIPOD)
    for value in (float("nan"), float("inf"), -1.0, 1e13, "x", 1j, True, (1.0,)):
        with pytest.raises(RobotError, match=rf"^Simulator: material\.{field} is .*: expected .*\[.*\]"):
            Simulator(model, material=ContactMaterial(**{field: value}))


@pytest.mark.stress
def test_wrong_values_for_longer(minutes):
    end, seed, robot = time.perf_counter() + 60 * minutes, 1, rich()
    known = [path for path in places(robot) if path]
    while time.perf_counter() < end:
        attack_at_random(random.Random(seed), robot, known)
        seed += 1
