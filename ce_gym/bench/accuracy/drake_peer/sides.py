"""Drake's methods for each scene, and their limits for short steps."""

from __future__ import annotations

from collections.abc import Iterator

from ce_gym.bench.accuracy.curves import ERROR_CONTROL, Measured, Side, rms_error
from ce_gym.bench.accuracy.drake_peer.peer import DISCRETE, Peer
from ce_gym.bench.accuracy.references import smooth as accuracy_references
from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene

STATED = ("humanoid", "tumble", "belt_leg", "stiff_1e3", "drop_3cm", "stick", "breakaway", "slide")
"""Scenes in Drake. Other scenes have loops, self-contact, belt springs or stairs, or need a Python system for a varying
push. Gains above 1e3 N m/rad, the trot and all landings except one are omitted, because integrators take minutes."""
STEPS, STEPS_IN_CONTACT = (1, 2, 5, 10, 20, 50, 100, 200), (1, 2, 5, 10, 20, 50, 100)
"""Steps per hold, in flight and in contact."""
FIXED = (1, 2, 5, 10, 20, 50)
"""Steps per hold of Runge-Kutta methods without error control."""
ACCURACIES, LOW_ORDER = tuple(10.0**-k for k in range(1, 12)), tuple(10.0**-k for k in range(1, 6))
"""Accuracies of integrators: of high order; of CENIC and of simplified levels."""
LIMIT = 200
"""Steps per hold of the finest of three runs, from which the limit of a discrete method is extrapolated."""


def sides(scene: Scene, truth: Array, measured: Measured) -> list[Side]:
    """Return Drake's levels, methods and steps for a scene; empty for a scene without a Drake version.

    Args:
        scene: The scene.
        truth: Reference solution of a smooth scene, shape (n_holds, nq).
        measured: Measurements, to which the accuracy of limits in contact is added.
    """
    if scene.name not in STATED:
        return []
    return list(_in_flight(scene, truth) if scene.smooth else _in_contact(scene, measured))


def _in_flight(scene: Scene, truth: Array) -> Iterator[Side]:
    """Yield sides without contact: one discrete method, and integrators, which need armature instead of couplings."""
    for level in scene.levels:
        exact = level in (scene.exact, "none")
        limit = truth if exact else accuracy_references.ours(scene, scene.reference // 2, level)
        yield from (_side(scene, level, "lagged", HOLD / n, limit) for n in STEPS)
        if level == "exact":
            continue
        for method in ("runge_kutta3", "runge_kutta5"):
            asked = ACCURACIES if exact else LOW_ORDER
            yield from (_side(scene, level, method, accuracy, limit) for accuracy in asked)
            yield from (_side(scene, level, f"{method}, fixed", HOLD / n, limit) for n in FIXED)
        yield from (_side(scene, level, "cenic", accuracy, limit) for accuracy in LOW_ORDER)
        if scene.control == "position":
            yield from (_side(scene, level, "radau3", accuracy, limit) for accuracy in LOW_ORDER[:3])


def _in_contact(scene: Scene, measured: Measured) -> Iterator[Side]:
    """Yield sides in contact, each compared with its own limit, at the fastest level.

    CENIC integrates the limit of the law of `lagged`, so both have the same limit.
    """
    level = scene.levels[0]
    for method in DISCRETE if level == "none" else DISCRETE[:3]:  # TAMSI has no controlled joints
        coarse, middle, fine = (Peer(scene, level, method, HOLD / n).run() for n in (LIMIT // 4, LIMIT // 2, LIMIT))
        limit = 2.0 * fine - middle
        measured.limits["Drake", f"{level}, {method}"] = rms_error(scene, 2.0 * middle - coarse, limit)
        yield from (_side(scene, level, method, HOLD / n, limit) for n in STEPS_IN_CONTACT)
        if method == "lagged":
            measured.limits["Drake", f"{level}, cenic"] = measured.limits["Drake", f"{level}, lagged"]
            yield from (_side(scene, level, "cenic", accuracy, limit) for accuracy in LOW_ORDER)


def _side(scene: Scene, level: str, method: str, step: float, limit: Array) -> Side:
    peer = Peer(scene, level, method, step)
    return Side(("Drake", f"{level}, {method}", _kind(method)), step, peer.run, 1, limit)


def _kind(method: str) -> str:
    """Return the kind of steps of a method."""
    if method in DISCRETE:
        return "discrete"
    return "fixed steps" if method.endswith("fixed") else ERROR_CONTROL
