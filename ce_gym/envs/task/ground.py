"""Look-ups of a terrain field under the robot, and the height at which a robot is put on the field.

A task looks up the field under the base and under each contact sphere, once in a control step after the physics.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from ce_gym.compile import Buffer, Call, Lookup, Step
from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.ground import above, lift, reach
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.hulls import Hull
from ce_gym.dynamics.laws.scene_parameters import law_values
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism
from ce_gym.sim.substeps import FRAME, HEIGHTS

SEEN = "seen_ground"
"""Buffer with height [m] and two slopes of the ground under the base, each contact sphere and each hull point."""


class Ground:
    """The terrain field under one robot.

    Args:
        mechanism: The robot.
        contacts: Names of the contact spheres that the physics computes.
        hulls: Convex hulls that touch the field with their points.
    """

    def __init__(self, mechanism: Mechanism, contacts: tuple[str, ...], hulls: tuple[Hull, ...]) -> None:
        self.mechanism, self.contacts, self.hulls = mechanism, contacts, hulls
        self.size = 3 * (1 + len(mechanism.robot.contacts) + sum(len(hull.points) for hull in hulls))

    def look_up(self, dependent: int) -> tuple[list[Buffer], tuple[Step, ...]]:
        """Return the buffers and the steps of the look-up, without table and frame.

        Args:
            dependent: Length of the state `dependent`; 0 for a robot without it.
        """
        q = SX.sym("q", self.mechanism.robot.layout.nq)
        state = {"q": q} | ({"dependent": SX.sym("dependent", dependent)} if dependent else {})
        points = ca.horzcat(q[:2], sphere_centres(self.mechanism, state)[:2, :], self._hull_points(state)[:2, :])
        places = traced("seen_places", state, {"seen_places": ca.vec(points)})
        buffers = [Buffer("seen_places", 2 * self.size // 3, "scratch"), Buffer(SEEN, self.size, "scratch")]
        call = Call(places, tuple(state), ("seen_places",))
        return buffers, (call, Lookup(HEIGHTS, FRAME, "seen_places", SEEN))

    def lift(self, q: SX, dependent: SX | None, seen: SX) -> SX:
        """Return how far to raise a robot so that no contact is deeper in the field than in flat ground [m].

        Args:
            q: Positions on flat ground at height 0, shape (nq,).
            dependent: State of that name; None for a robot without it.
            seen: The buffer `SEEN`.
        """
        spheres = self.mechanism.robot.contacts
        state = {"q": q} | ({} if dependent is None else {"dependent": dependent})
        centres, axes = sphere_centres(self.mechanism, state), sphere_axes(self.mechanism, state)
        planes, z = ca.reshape(seen[3:], 3, -1), centres[2, :]
        lifts = []
        for i, sphere in enumerate(spheres):
            if sphere.name in self.contacts:
                height, *slopes = ca.vertsplit(planes[:, i])
                level = reach(sphere.radius, sphere.rim, axes[:, i])
                extra = reach(sphere.radius, sphere.rim, axes[:, i], *slopes) - level
                lifts.append(lift(ca.fmin(z[i], level) + extra, z[i], height, *slopes))
        radii = [hull.radius for hull in self.hulls for _ in hull.points]
        hull_planes = ca.horzsplit(planes[:, len(spheres) :])
        for radius, point, plane in zip(radii, ca.horzsplit(self._hull_points(state)), hull_planes, strict=True):
            height, *slopes = ca.vertsplit(plane)
            lifts.append(lift(ca.fmin(point[2], radius), point[2], height, *slopes))
        return ca.mmax(ca.vertcat(*lifts)) if lifts else seen[0]

    def _hull_points(self, state: Mapping[str, SX]) -> SX:
        """Return the points of the hulls in the world [m], shape (3, n_points)."""
        bodies = _at_rest(self.mechanism, state).bodies if self.hulls else {}
        points = [bodies[hull.body].point_position(SX(ca.DM(point))) for hull in self.hulls for point in hull.points]
        return ca.horzcat(SX(3, 0), *points)


def sphere_centres(mechanism: Mechanism, state: Mapping[str, SX]) -> SX:
    """Return the centres of the contact spheres in the world [m], shape (3, n_spheres).

    Args:
        mechanism: The robot.
        state: `q`, and `dependent` for a robot that has it.
    """
    bodies = _at_rest(mechanism, state).bodies
    points = [bodies[s.body].point_position(constant(np.array(s.position))) for s in mechanism.robot.contacts]
    return ca.horzcat(SX(3, 0), *points)


def sphere_axes(mechanism: Mechanism, state: Mapping[str, SX]) -> SX:
    """Return the rim axis of each contact in the world, shape (3, n_spheres); unused for contacts without a rim."""
    bodies = _at_rest(mechanism, state).bodies
    axes = [bodies[s.body].R @ constant(np.array(s.axis)) for s in mechanism.robot.contacts]
    return ca.horzcat(SX(3, 0), *axes)


def _at_rest(mechanism: Mechanism, state: Mapping[str, SX]) -> Kinematics:
    return outward_velocity_pass(mechanism, state["q"], SX(mechanism.robot.layout.nv, 1), state.get("dependent"))


def resting_load(mechanism: Mechanism, options: StepOptions, state: Mapping[str, SX], seen: SX | None) -> SX:
    """Return the spring forces on the contacts of a robot at rest [N], shape (n_touches,).

    The friction of the first sub-step uses these normal forces.

    Args:
        mechanism: The robot.
        options: The scene.
        state: State of the robot, with `parameters` if the scene has any.
        seen: The buffer `SEEN`; None on flat ground.
    """
    parameters = state.get("parameters", SX(0, 1))
    stiffness = law_values(mechanism.robot, options.material, options.parameters, parameters)["stiffness"]
    centres, axes, load = sphere_centres(mechanism, state), sphere_axes(mechanism, state), []
    for i, sphere in enumerate(mechanism.robot.contacts):
        if sphere.name in options.contacts:
            height, *slopes = ca.vertsplit(SX(3, 1) if seen is None else seen[3 * i + 3 : 3 * i + 6])
            depth = reach(sphere.radius, sphere.rim, axes[:, i], *slopes) - above(centres[2, i], height, *slopes)
            load.append(stiffness * ca.fmax(depth, 0))
    return ca.vertcat(*load, SX(len(options.touches) - len(options.contacts), 1))
