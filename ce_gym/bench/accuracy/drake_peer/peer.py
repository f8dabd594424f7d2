# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
"""Robots in Drake in a scene, with discrete steps or with integrators with error control."""

from __future__ import annotations

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig

from ce_gym.bench.accuracy.drake_peer.plant import put_inertias, stated
from ce_gym.bench.accuracy.scenarios import HOLD, Array, Scene
from ce_gym.dynamics.model import Model


class Peer:
    """One robot in Drake.

    Args:
        scene: The scene.
        level: "none", "armature" or "exact".
        method: An approximation of discrete contact ("sap", "similar", "lagged", "tamsi") or an integrator of Drake,
            such as "runge_kutta3", or "runge_kutta3, fixed" for fixed steps.
        step: Step length [s], or the accuracy of an integrator.
    """

    def __init__(self, scene: Scene, level: str, method: str, step: float) -> None:
        self.scene, discrete = scene, method in DISCRETE
        self.stated = stated(scene, level, step if discrete else 0.0, method if discrete else "")
        plant = self.stated.plant
        self.simulator = Simulator(self.stated.diagram)
        if not discrete:
            scheme, _, fixed = method.partition(", ")
            most, accuracy = (step, 1e-3) if fixed else (HOLD, step)
            config = SimulatorConfig(
                integration_scheme=scheme, max_step_size=most, accuracy=accuracy, use_error_control=not fixed
            )
            ApplySimulatorConfig(config, self.simulator)
        self.context = self.simulator.get_mutable_context()
        self.of_plant = plant.GetMyMutableContextFromRoot(self.context)
        put_inertias(self.stated, self.of_plant)
        self._put_start()
        self.start = plant.GetPositionsAndVelocities(self.of_plant).copy()
        joints = [plant.GetJointByName(name).position_start() for name in scene.robot.independent]
        self.columns = [*((4, 5, 6, 0, 1, 2, 3) if scene.robot.floating else ()), *joints]

    def _put_start(self) -> None:
        plant, scene, context = self.stated.plant, self.scene, self.of_plant
        model = Model(scene.robot)
        q, v = model.spanning(scene.q, scene.v)
        if scene.robot.floating:
            base = plant.GetBodyByName(scene.robot.bodies[0].name)
            turned = RotationMatrix(Quaternion(q[3:7] / np.linalg.norm(q[3:7])))
            plant.SetFreeBodyPose(context, base, RigidTransform(turned, q[:3]))
            twist = SpatialVelocity(turned.multiply(v[:3]), turned.multiply(v[3:6]))
            plant.SetFreeBodySpatialVelocity(context=context, body=base, V_JpJc=twist)
            q, v = q[7:], v[6:]
        for name, *state in zip(model.spanning_names, q, v, strict=True):
            if plant.HasJointNamed(name):
                joint = plant.GetJointByName(name)
                joint.set_angle(context, state[0])
                joint.set_angular_rate(context, state[1])

    def run(self) -> Array:
        """Simulate the scene; return positions in coordinates of ce_gym at the end of every hold, shape (n_holds, nq).

        Positions are NaN if the run ends with an error, for example if the integrator finds no step short enough.
        """
        self.context.SetTime(0.0)
        self.stated.plant.SetPositionsAndVelocities(self.of_plant, self.start)
        log = self.stated.log.FindMutableLog(self.context)
        log.Clear()
        try:
            self.simulator.Initialize()
            self.simulator.AdvanceTo(self.scene.holds * HOLD)
        except RuntimeError:
            return np.full((self.scene.holds, len(self.scene.q)), np.nan)
        return log.data().T[-self.scene.holds :, self.columns]


DISCRETE = ("sap", "similar", "lagged", "tamsi")
"""Drake's approximations of discrete contact; without contact and couplings they are the same method."""
