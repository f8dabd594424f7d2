"""Robots that must come to rest, beside MuJoCo with every integrator on the same cells: feet, stairs, legs, a biped.

They are scenes of the accuracy benchmark, gone on with: what is asked for at their end is held. A cell is a scene at
one step; it is finite if nothing diverges, and at rest if joints and base then move by no more than `AT_REST`. Both
codes have their own contact laws, and all their transmission levels.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ce_gym.bench.accuracy.curves import INTEGRATORS
from ce_gym.bench.accuracy.ours import Ours
from ce_gym.bench.accuracy.peers import Peer, families
from ce_gym.bench.accuracy.scenarios import HOLD, SCENES, Array, Scene, Way
from ce_gym.bench.measure.report import Cell, Table
from ce_gym.model.mechanism import ELASTIC
from ce_gym.viewer.console import shown

STEPS = (20, 10, 4, 2, 1)
"""Steps to a hold: 1 to 20 ms."""
METHODS = ("euler", "extrapolated", "adaptive")
TOLERANCE = 1e-3
"""Of the adaptive one [rad and m]; its longest steps are those of the cell."""
WATCHED = 25
"""Holds over which speeds are taken, at the end."""
AT_REST = 1e-3
"""Largest root mean square speed, from positions [m/s and rad/s]: what can be seen."""
STRETCHING = f" {ELASTIC}"
"""What names of scenes end with whose transmissions stretch."""


@dataclass(frozen=True)
class Rest:
    """What became of one side in one cell.

    Attributes:
        finite: Whether it did not diverge.
        speed: Root mean square speed at the end [m/s and rad/s].
    """

    finite: bool
    speed: float

    @property
    def still(self) -> bool:
        """Whether it came to rest."""
        return self.finite and self.speed <= AT_REST


def resting(name: str, time: float) -> Scene:
    """Return a scene that holds what it asks for when it is most, for some time [s].

    "NAME elastic" is the scene whose robot's transmissions stretch, with backlash, which MuJoCo cannot state.
    """
    scene = SCENES[name.removesuffix(STRETCHING)]()
    if name.endswith(STRETCHING):
        scene = replace(scene, exact=ELASTIC, levels=())
    ahead = int(np.argmax(np.abs(scene.drive - scene.drive[0]).max(axis=1)))
    held = np.tile(scene.drive[ahead], (round(time / HOLD) - ahead, 1))
    return replace(scene, drive=np.concatenate([scene.drive[:ahead], held]), spread=0.0)


def rest(path: Array) -> Rest:
    """Judge positions at the ends of holds, shape (n_holds, nq)."""
    if not np.isfinite(path).all():
        return Rest(False, np.inf)
    return Rest(True, float(np.sqrt(np.mean(np.square(np.diff(path[-WATCHED:], axis=0) / HOLD)))))


def cells(scene: Scene, steps: tuple[int, ...]) -> Iterator[tuple[str, int, Rest]]:
    """Yield what became of each way of ours and of MuJoCo's at each step to a hold."""
    for method in METHODS:
        ours = Ours(scene, Way(method, scene.exact), 1)
        for n in steps:
            yield f"ce_gym, {method}", n, rest(ours.run(n, TOLERANCE if method == "adaptive" else None))
    for family, integrator in itertools.product(families(scene), INTEGRATORS):
        for n in steps:
            yield f"MuJoCo {family.name}, {integrator}", n, rest(Peer(family, integrator, n).run())


def measure(names: tuple[str, ...], steps: tuple[int, ...], time: float) -> tuple[Table, list[str]]:
    """Return the cells side by side, and those of ours that are not at rest where some way of MuJoCo's is."""
    rows: list[tuple[Cell, ...]] = []
    behind = []
    for name in shown(names, "beside MuJoCo"):
        found = list(cells(resting(name, time), steps))
        for way in dict.fromkeys(way for way, _, _ in found):
            rows.append((name, way, *(_text(r) for w, _, r in found if w == way)))
        still = {n for way, n, r in found if r.still and way.startswith("MuJoCo")}
        lost = [(way, n) for way, n, r in found if way.startswith("ce_gym") and n in still and not r.still]
        behind += [f"{name}, {way}, {1e3 * HOLD / n:g} ms" for way, n in lost]
    columns = ("scene", "way", *(f"{1e3 * HOLD / n:g} ms" for n in steps))
    return Table(f"Speed after {time:g} s, beside MuJoCo", columns, tuple(rows)), behind


def _text(found: Rest) -> str:
    return ("" if found.still else "moves, ") + f"{found.speed:.0e}" if found.finite else "lost"
