"""The standing pose of a robot whose file does not name an angle for every joint."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ce_gym.model.description import Body

Pairs = tuple[tuple[str, float], ...]


def complete_pose(pose: Pairs, bodies: Iterable[Body], independent: Sequence[str]) -> Pairs:
    """Return a pose of all independent joints; joints without angle are as near to zero as their limits allow.

    Args:
        pose: Pairs (body, angle) [rad or m].
        bodies: The robot's bodies.
        independent: Bodies whose joint coordinates are independent.
    """
    named, limits = dict(pose), {body.name: body.joint.position for body in bodies}
    nearest = [(joint, min(max(0.0, limits[joint][0]), limits[joint][1])) for joint in independent if joint in limits]
    return (*pose, *((joint, angle) for joint, angle in nearest if joint not in named and angle != 0.0))
