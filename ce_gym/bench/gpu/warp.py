# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
"""MuJoCo Warp on the GPU, with the same robot, feet and step. Needs the package `mujoco-warp` and a GPU."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from ce_gym.bench.gpu.speed import DT, SUBSTEPS, Rates, Unmeasured, best_rate
from ce_gym.bench.peers import stand
from ce_gym.export import mujoco_model
from ce_gym.model import load_robot


def rates(robot: str, sizes: Sequence[int], rounds: int) -> Rates:
    """Return sub-steps per second of MuJoCo Warp at the levels exact and armature, from the standing pose.

    Raises:
        ImportError: If `mujoco_warp` is not installed.
    """
    import mujoco_warp
    import warp as wp

    found: Rates = {}
    for level in ("exact", "armature"):
        model = mujoco_model.load(stand.bare(load_robot(robot), "foot"), level, timestep=DT, integrator="Euler")
        model.opt.iterations, model.opt.ls_iterations = 4, 4
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_forward(model, data)
        device_model = mujoco_warp.put_model(model)
        for size in sizes:
            worlds = mujoco_warp.put_data(model, data, nworld=size)
            mujoco_warp.step(device_model, worlds)
            with wp.ScopedCapture() as capture:
                for _ in range(SUBSTEPS):
                    mujoco_warp.step(device_model, worlds)
            rate = best_rate(lambda graph=capture.graph: wp.capture_launch(graph), size * SUBSTEPS, rounds)
            if not np.isfinite(worlds.qpos.numpy()).all():
                raise Unmeasured(f"MuJoCo Warp, {level}: states are not finite")
            found.setdefault(f"MuJoCo Warp, {level}", {})[size] = rate
    return found
