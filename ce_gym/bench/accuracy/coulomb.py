"""How far a block slides, as a share of what rigid bodies with Coulomb's friction do: a reference in closed form.

Under a constant push of `s` times the cone a block at rest covers (s - 1) mu g t^2 / 2. Compliance and regularised
friction leave a little of their own, which the shortest step shows; the rest is the method's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ce_gym.bench.accuracy.curves import INTEGRATORS
from ce_gym.bench.accuracy.ours import Ours
from ce_gym.bench.accuracy.peers import Family, Peer
from ce_gym.bench.accuracy.scenarios import BLOCK_FRICTION, GRAVITY, HOLD, SCENES, Array
from ce_gym.bench.measure.report import Cell, Table

PUSHES = {"breakaway": 1.2, "slide": 2.0}
"""Push of the scenes in parts of the cone."""
STEPS = (1, 2, 5, 20, 1000)
"""Steps to a hold."""


def distance_table() -> Table:
    """Return distances slid, divided by the analytic ones, for every method and a few steps."""
    rows: list[tuple[Cell, ...]] = []
    for name, push in PUSHES.items():
        scene = SCENES[name]()
        exact = 0.5 * (push - 1.0) * BLOCK_FRICTION * GRAVITY * scene.duration**2
        family = Family(scene, "none", stiff=False)
        ways: dict[str, Callable[[int], Array]] = {
            f"ce_gym {way.method}, {way.friction} friction": Ours(scene, way, 1).run
            for way in scene.ours
            if way.method != "adaptive" and way.dtype == "float64"  # steps of its own; the same to what is printed
        }
        ways |= {f"MuJoCo {integrator}": partial(_peer, family, integrator) for integrator in INTEGRATORS}
        rows += [(name, way, *(float(run(n)[-1, 0]) / exact for n in STEPS)) for way, run in ways.items()]
    columns = ("scene", "method", *(f"dt {1e3 * HOLD / n:g} ms" for n in STEPS))
    return Table("Distance slid, as a share of the rigid Coulomb block's", columns, tuple(rows))


def _peer(family: Family, integrator: str, n: int) -> Array:
    return Peer(family, integrator, n).run()
