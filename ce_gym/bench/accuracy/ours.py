"""ce_gym in the accuracy benchmark: one kernel of the simulator computes all points of a curve."""

from __future__ import annotations

import numpy as np

from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene, Way
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.model import Model
from ce_gym.dynamics.stepping.step_size import control_sizes
from ce_gym.sim.ground_clearance import GroundClearance
from ce_gym.sim.schema import FIRST
from ce_gym.sim.substeps import FRAME, HEIGHTS, load_step_kernel
from ce_gym.sim.tiles import tiles, write_rows


class Ours:
    """A batch of robots in a scene; the first robot starts exactly at the initial state of the scene.

    Args:
        scene: The scene.
        way: Method, level, friction and precision.
        num_envs: Number of robots.
    """

    def __init__(self, scene: Scene, way: Way, num_envs: int) -> None:
        self.scene, self.num_envs = scene, num_envs
        self.model = Model(scene.robot, transmission=way.level)
        options = StepOptions(
            control=scene.control,
            contacts=self.model.contact_names,
            material=scene.robot.material,
            friction=way.friction,
            method=way.method,
            ground="flat" if scene.terrain is None else "field",
            parameters=() if scene.push is None else ("gravity",),
            self_collisions=scene.touching,
        )
        self.kernel = load_step_kernel(self.model, options, (), way.dtype)
        self.arrays = {
            name: tiles(num_envs, buffer.size, way.dtype)
            for name, buffer in self.kernel.buffers.items()
            if buffer.kind == "tiles"
        }
        self.tables: dict[str, Array] = {}
        if scene.terrain is not None:
            self.tables[HEIGHTS] = scene.terrain.heights.astype(way.dtype)
            write_rows(self.arrays[FRAME], np.array([*scene.terrain.origin, scene.terrain.cell]))
        self.starts = self._starts()
        joints = len(self.model.joint_links)
        rows = (np.broadcast_to(row, (num_envs, joints)) for row in scene.drive)
        self.targets = [np.ascontiguousarray(row, way.dtype) for row in rows]

    def run(self, n: int, tolerance: float | None = None) -> Array:
        """Simulate the scene and return positions of the first robot at the end of every hold, shape (n_holds, nq).

        Positions do not contain elastic stretches.

        Args:
            n: Sub-steps per hold.
            tolerance: Tolerance of an adaptive method [rad or m].
        """
        for name, rows in self.starts.items():
            write_rows(self.arrays[name], rows)
        self.arrays["dt"][:] = HOLD / n
        if tolerance is not None:
            for name in control_sizes(self.model.robot.layout):
                self.arrays[name][:] = {"step_length": HOLD / n / FIRST, "tolerance": tolerance}.get(name, 0.0)
            self.arrays["retries"][:] = 0.0
        path, given = np.empty((self.scene.holds, len(self.scene.q))), self.arrays | self.tables
        for i, target in enumerate(self.targets):
            if self.scene.push is not None:
                self.arrays["parameters"][:] = (np.array(self.scene.robot.gravity) + self.scene.push[i])[:, None]
            self.kernel(given | {"target": target}, self.num_envs, repeats={"n_substeps": n})
            path[i] = self.arrays["q"][0, : path.shape[1], 0]
        if self.arrays["diverged"].max() > 0.5:
            path[:] = np.nan
        return path

    def _starts(self) -> dict[str, Array]:
        """Return initial rows of every state array; robots differ slightly, so that iterations differ, too."""
        model, scene = self.model, self.scene
        base = 7 if scene.robot.floating else 0
        q, v = np.zeros((self.num_envs, model.nq)), np.zeros((self.num_envs, model.nv))
        q[:, : len(scene.q)], v[:, : len(scene.v)] = scene.q, scene.v  # elastic stretches are last
        noise = scene.spread * np.random.default_rng(0).normal(size=(self.num_envs, len(scene.q) - base + 1))
        noise[0] = 0.0
        q[:, base : len(scene.q)] += noise[:, 1:]
        if base:
            q[:, 2] += noise[:, 0]
        rows = {"q": q, "v": v, "diverged": np.zeros((self.num_envs, 1))}
        if model.contact_names:
            depth = GroundClearance(model, model.contact_names, scene.terrain).depth(q)
            loads = scene.robot.material.stiffness * depth
            rows |= {name: loads for name in ("load", "whole_load") if name in self.arrays}
        for name in ("anchor", "pair_force"):
            if name in self.arrays:
                rows[name] = np.zeros((self.num_envs, self.arrays[name].shape[1]))
        if "dependent" in self.arrays:
            rows["dependent"] = model.dependent_guess(q)
        return rows
