"""How a task sees the ground of a field, and puts robots on it: traced functions around a look-up.

Of a field the task knows what is under the base and under every contact sphere of the robot, looked up once in a
control step, after the physics.
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
"""Buffer with height [m] and slopes of the ground under the base and under each contact sphere, one after the other."""


class Ground:
    """The ground of a field under one robot.

    Args:
        mechanism: The robot.
        contacts: Names of the spheres that take part in the physics.
        hulls: Convex shapes whose corners some of these are.
    """

    def __init__(self, mechanism: Mechanism, contacts: tuple[str, ...], hulls: tuple[Hull, ...]) -> None:
        self.mechanism, self.contacts, self.hulls = mechanism, contacts, hulls
        self.size = 3 * (1 + len(mechanism.robot.contacts) + sum(len(hull.points) for hull in hulls))

    def look(self, dependent: int) -> tuple[list[Buffer], tuple[Step, ...]]:
        """Return how to look at the ground, and the buffers for it but table and frame.

        Args:
            dependent: Length of the state `dependent`; 0 if there is none.
        """
        q = SX.sym("q", self.mechanism.robot.layout.nq)
        given = {"q": q} | ({"dependent": SX.sym("dependent", dependent)} if dependent else {})
        at = ca.horzcat(q[:2], sphere_centres(self.mechanism, given)[:2, :], self._between(given)[:2, :])
        places = traced("seen_places", given, {"seen_places": ca.vec(at)})
        buffers = [Buffer("seen_places", 2 * self.size // 3, "scratch"), Buffer(SEEN, self.size, "scratch")]
        call = Call(places, tuple(given), ("seen_places",))
        return buffers, (call, Lookup(HEIGHTS, FRAME, "seen_places", SEEN))

    def lift(self, q: SX, dependent: SX | None, seen: SX) -> SX:
        """Return how far to raise a robot for no contact to be deeper in the ground than it would be in flat [m].

        Args:
            q: Positions with the height that the robot would have on flat ground, shape (nq,).
            dependent: State of that name, if there is one.
            seen: The buffer `SEEN`.
        """
        spheres = self.mechanism.robot.contacts
        state = {"q": q} | ({} if dependent is None else {"dependent": dependent})
        centres, axes = sphere_centres(self.mechanism, state), sphere_axes(self.mechanism, state)
        chosen = [i for i, sphere in enumerate(spheres) if sphere.name in self.contacts]
        under, z = ca.reshape(seen[3:], 3, -1), centres[2, :]
        needed = []
        for i in chosen:
            height, *slopes = ca.vertsplit(under[:, i])
            level = reach(spheres[i].radius, spheres[i].rim, axes[:, i])
            more = reach(spheres[i].radius, spheres[i].rim, axes[:, i], *slopes) - level
            needed.append(lift(ca.fmin(z[i], level) + more, z[i], height, *slopes))
        radii = [hull.radius for hull in self.hulls for _ in hull.points]
        of_hulls = zip(radii, ca.horzsplit(self._between(state)), ca.horzsplit(under[:, len(spheres) :]), strict=True)
        for radius, point, plane in of_hulls:
            height, *slopes = ca.vertsplit(plane)
            needed.append(lift(ca.fmin(point[2], radius), point[2], height, *slopes))
        return ca.mmax(ca.vertcat(*needed)) if needed else seen[0]

    def _between(self, state: Mapping[str, SX]) -> SX:
        """Return where the points of hulls are [m], shape (3, n_points)."""
        bodies = _at_rest(self.mechanism, state).bodies if self.hulls else {}
        points = [bodies[hull.body].point_position(SX(ca.DM(point))) for hull in self.hulls for point in hull.points]
        return ca.horzcat(SX(3, 0), *points)


def sphere_centres(mechanism: Mechanism, state: Mapping[str, SX]) -> SX:
    """Return where the contact spheres of a robot are [m], shape (3, n_spheres); `dependent` is used if it is there."""
    bodies = _at_rest(mechanism, state).bodies
    points = [bodies[s.body].point_position(constant(np.array(s.position))) for s in mechanism.robot.contacts]
    return ca.horzcat(SX(3, 0), *points)


def sphere_axes(mechanism: Mechanism, state: Mapping[str, SX]) -> SX:
    """Return about what they move, those that do, in the world, shape (3, n_spheres)."""
    bodies = _at_rest(mechanism, state).bodies
    axes = [bodies[s.body].R @ constant(np.array(s.axis)) for s in mechanism.robot.contacts]
    return ca.horzcat(SX(3, 0), *axes)


def _at_rest(mechanism: Mechanism, state: Mapping[str, SX]) -> Kinematics:
    return outward_velocity_pass(mechanism, state["q"], SX(mechanism.robot.layout.nv, 1), state.get("dependent"))


def resting_load(mechanism: Mechanism, options: StepOptions, state: Mapping[str, SX], seen: SX | None) -> SX:
    """Return the springs' forces on the contacts [N], shape (n_touches,): what friction has to go by at first.

    Args:
        mechanism: The robot.
        options: Its scene.
        state: Of it, with the parameters that are declared.
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
