"""Transmissions that stretch: their stiffness, damping, backlash and energy."""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.model.drives import Elasticity
from ce_gym.model.mechanism import Mechanism


def stretching(mechanism: Mechanism) -> list[tuple[int, Elasticity]]:
    """Return the elastic transmissions that stretch, each with the row of its stretch among the joints' coordinates."""
    robot = mechanism.robot
    rows = {name: row for row, name in enumerate(robot.independent)}
    return [(rows[elastic.stretch], elastic) for elastic in robot.elastic if elastic.stretch in rows]


def mesh_parameters(scene: Scene, elastic: Elasticity) -> tuple[SX, SX, SX]:
    """Return stiffness [N m/rad] and damping [N m s/rad] of a side, and backlash [rad].

    A transmission without sides has one spring and damper. A strand has half the stiffness and damping of its belt.
    """
    values, share = scene.values, 1.0 if elastic.linear or elastic.backlash else 0.5
    k, d = share * elastic.stiffness * values["drive_stiffness"], share * elastic.damping * values["drive_damping"]
    return k, d, elastic.backlash * elastic.play * values["backlash"]


def gap_of(elastic: Elasticity, k: SX, backlash: SX) -> SX:
    """Return the stretch at which a side with stiffness k begins to push [rad]."""
    return backlash / 2 if elastic.backlash else -elastic.preload / (2 * k)


def mesh_energy(scene: Scene, y: SX) -> SX:
    """Return the elastic energy of all transmissions at positions of joints and stretches (n,) [J]."""
    total = SX(0)
    for row, elastic in stretching(scene.mechanism):
        k, _, backlash = mesh_parameters(scene, elastic)
        if elastic.linear:
            total += k * y[row] ** 2 / 2
            continue
        gap = gap_of(elastic, k, backlash)
        total += k * (ca.fmax(y[row] - gap, 0) ** 2 + ca.fmax(-y[row] - gap, 0) ** 2) / 2
    return total
