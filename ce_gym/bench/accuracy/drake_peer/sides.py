"""Which of Drake's ways run through which scene, and what each of them tends to."""

from __future__ import annotations

from collections.abc import Iterator

from ce_gym.bench.accuracy.curves import ERROR_CONTROL, Measured, Side, rms_error
from ce_gym.bench.accuracy.drake_peer.peer import DISCRETE, Peer
from ce_gym.bench.accuracy.references import smooth as accuracy_references
from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene

STATED = ("humanoid", "tumble", "belt_leg", "stiff_1e3", "drop_3cm", "stick", "breakaway", "slide")
"""Scenes that are stated in Drake. A push that varies would need a system of Python's; loops, links that touch, springs
of belts and stairs are not stated; gains above 1e3 N m/rad, the trot and all landings but one, on which integrators
spend minutes, are left out to keep the benchmark short."""
STEPS, STEPS_IN_CONTACT = (1, 2, 5, 10, 20, 50, 100, 200), (1, 2, 5, 10, 20, 50, 100)
"""Steps to a hold."""
FIXED = (1, 2, 5, 10, 20, 50)
"""The same of Runge-Kutta methods without error control."""
ACCURACIES, LOW_ORDER = tuple(10.0**-k for k in range(1, 12)), tuple(10.0**-k for k in range(1, 6))
"""Asked of integrators: of those of high order, and of CENIC and of those whose level leaves something out."""
LIMIT = 200
"""Steps to a hold of the finest of three runs from which a discrete method's limit is extrapolated."""


def sides(scene: Scene, truth: Array, measured: Measured) -> list[Side]:
    """Return Drake's levels, methods and steps of a scene; none if it is not stated.

    Args:
        scene: The scene.
        truth: What a smooth scene really does, shape (n_holds, nq).
        measured: Gets how well the limits of contact are known.
    """
    if scene.name not in STATED:
        return []
    return list(_in_flight(scene, truth) if scene.smooth else _in_contact(scene, measured))


def _in_flight(scene: Scene, truth: Array) -> Iterator[Side]:
    """Without contact all discrete approximations are one; integrators know no ties, and have rotors as armature."""
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
    """Each approximation is held against its own limit, as all in contact: so the cheapest level serves.

    CENIC integrates the law that `lagged` tends to, whose limit is better known.
    """
    level = scene.levels[0]
    for method in DISCRETE if level == "none" else DISCRETE[:3]:  # TAMSI knows no controlled joints
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
    """Return what kind of steps a method makes."""
    if method in DISCRETE:
        return "discrete"
    return "fixed steps" if method.endswith("fixed") else ERROR_CONTROL
