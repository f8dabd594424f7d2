"""The kernel that repeats the sub-steps of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ce_gym.compile import Buffer, Program
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.self_contact import apart_when_standing
from ce_gym.model import Robot
from ce_gym.model.checks.collisions import adjacent, capsules_of, colliding
from ce_gym.model.errors import check_names
from ce_gym.model.mechanism import Mechanism
from ce_gym.sim.devices import Cpu, Device
from ce_gym.sim.kernel_key import laws_key, model_key
from ce_gym.sim.substeps import substeps

MOST_PAIRS = 32
"""Most pairs of capsules in a scene, because the system of their forces is dense."""


def select_contacts(robot: Robot, contacts: str | Sequence[str], argument: str = "contacts") -> tuple[str, ...]:
    """Return names of contact spheres, in the robot's order.

    Args:
        robot: The robot.
        contacts: "all", or names of spheres or groups of spheres, one or several.
        argument: Name of the argument in errors.

    Raises:
        ValueError: If a name is not a sphere or a group, or is listed twice.
    """
    names = [contacts] if isinstance(contacts, str) else list(contacts)
    known = sorted({c.group for c in robot.contacts} | {c.name for c in robot.contacts})
    listed = [name for name in names if name != "all"]
    check_names(argument, listed, known, "'all', groups or names among")
    wanted = set(names)
    return tuple(c.name for c in robot.contacts if wanted & {"all", c.group, c.name})


def select_pairs(mechanism: Mechanism, pairs: str | Sequence[Sequence[str]]) -> tuple[tuple[str, str], ...]:
    """Return pairs of links that push each other apart, each of which has a capsule.

    Args:
        mechanism: The robot.
        pairs: "listed", "all", or pairs of names.

    Raises:
        ValueError: If a link does not exist or has no capsule, or the choice is unknown.
    """
    robot = mechanism.robot
    if isinstance(pairs, str) and pairs not in ("listed", "all"):
        raise ValueError(f"self_collisions={pairs!r}; expected 'listed', 'all', or pairs of names of links")
    everything = apart_when_standing(mechanism) if pairs == "all" else robot.self_collisions
    chosen = everything if isinstance(pairs, str) else tuple(tuple(pair) for pair in pairs)
    known = [body.name for body in robot.bodies if body.kind == "link" and capsules_of(robot, body.name)]
    for pair in chosen:
        if len(pair) != 2:
            raise ValueError(f"self_collisions: {pair!r}; expected two links")
        check_names("self_collisions", pair, known, "a link with capsules among")
        if adjacent(*map(robot.body, pair)):
            raise ValueError(f"self_collisions: {pair!r}; expected two links of which none carries the other")
    unordered = [" and ".join(sorted(pair)) for pair in chosen]
    check_names("self_collisions", unordered, unordered, "a pair of links among")
    if (count := len(colliding(robot, chosen))) > MOST_PAIRS:  # type: ignore[arg-type]
        raise ValueError(
            f"self_collisions: {count} pairs of capsules; expected at most {MOST_PAIRS}, name those that matter"
        )
    return chosen  # type: ignore[return-value]


def load_step_kernel(
    model: Model, options: StepOptions, outputs: tuple[str, ...], dtype: str, device: Device | None = None
) -> Any:
    """Compile, or load from the cache, the kernel that repeats a sub-step.

    Args:
        model: The robot at a transmission level.
        options: The scene.
        outputs: Quantities to compute besides the state.
        dtype: "float64" or "float32".
        device: Device of the kernel; the CPU if None.
    """

    def build() -> tuple[Program]:
        sizes, further, steps = substeps(model.mechanism, options, outputs)
        joints = sizes.pop("target", 0)
        buffers = [Buffer(name, size, "tiles") for name, size in sizes.items()]
        buffers += [Buffer("target", joints, "rows_in")] if joints else []
        return (Program(f"{model.robot.name} {model.transmission} step", tuple(buffers + further), steps),)

    key = f"step {model_key(model)} {options!r} {laws_key(model.mechanism, options)} {outputs!r}"
    return (device or Cpu()).kernel(key, build, dtype)
