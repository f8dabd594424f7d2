"""Traced functions around the look-ups that find the ground under each contact on a height field.

A sphere on a slope touches the ground beside the point under its centre. So the field is looked up twice: under the
centre, and where a sphere would touch the plane found there. The plane at the second point is the contact plane, up to
errors of second order in the change of the slope over a radius. With the first look-up alone, forces would not be
normal to the path of a rolling sphere, and energy would grow. Spheres without radius need one look-up. For a rim, the
second look-up is beside the centre of the rim.

Hulls, see `ce_gym.dynamics.hulls`, are looked up at all of their points.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.ground import above_deepest
from ce_gym.dynamics.forces.scene import StepOptions, contact_spheres
from ce_gym.dynamics.hulls import hull_contacts
from ce_gym.dynamics.laws.scene_laws import symbolic_state
from ce_gym.dynamics.recursion.kinematics import Kinematics, constant, outward_velocity_pass
from ce_gym.model.mechanism import Mechanism


def places_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace x and y of the centres of the contact spheres.

    Returns:
        Function (q) or, for a robot whose loops need guesses, (q, dependent) -> x and y of each centre [m], shape
        (2 n_contacts,).
    """
    given, kinematics = _posed(mechanism, options)
    centres = [(sphere.body, np.array(sphere.position)) for sphere in contact_spheres(mechanism, options)]
    return traced("places", given, {"places": ca.vec(_in_world(kinematics, centres)[:2, :])})


def touching_function(mechanism: Mechanism, options: StepOptions) -> ca.Function | None:
    """Trace x and y of the points where spheres with a radius, and rims, would touch a plane.

    Returns:
        Function (places, ground) or, for a robot with rims, (q, places, ground), or with `dependent` as for
        `places_function`, -> x and y of the touching points [m], shape (2 m,), from the centres and the height and
        slopes under them, shape (3 n_contacts,); None if no sphere has a radius.
    """
    radius, round_ones, places, ground = _spheres(mechanism, options)
    if not round_ones:
        return None
    slope = ground[1:, round_ones]
    lean = slope * ca.repmat(radius / ca.sqrt(1 + ca.sum1(slope**2)), 2, 1)
    given = {"places": ca.vec(places), "ground": ca.vec(ground)}
    if any(sphere.rim for sphere in contact_spheres(mechanism, options)):
        state, lean = _leaning(mechanism, options, slope, round_ones)
        given = state | given
    return traced("touching", given, {"touching": ca.vec(places[:, round_ones] + lean)})


def _leaning(mechanism: Mechanism, options: StepOptions, slope: SX, round_ones: list[int]) -> tuple[dict[str, SX], SX]:
    """Return symbols of the pose, and x and y from centres to points where spheres touch planes, shape (2, m)."""
    given, kinematics = _posed(mechanism, options)
    spheres, offsets = contact_spheres(mechanism, options), [SX(2, 0)]
    for i, column in zip(round_ones, ca.horzsplit(slope), strict=True):
        axis = kinematics.bodies[spheres[i].body].R @ constant(np.array(spheres[i].axis))
        normal = ca.vertcat(-column, 1) / ca.sqrt(1 + ca.sumsqr(column))
        offsets.append(-above_deepest(spheres[i].radius, spheres[i].rim, normal, axis, ca.dot(axis, normal))[:2])
    return given, ca.horzcat(*offsets)


def planes_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace the contact planes of spheres.

    Returns:
        Function (places, ground, touching, touching_ground) -> ground, shape (3 n_contacts,): height of the contact
        plane under each centre [m] and its slopes. `touching_ground` are height and slopes at `touching`, shape (3 m,).
    """
    _, round_ones, places, ground = _spheres(mechanism, options)
    touching, at_touching = SX.sym("touching", 2, len(round_ones)), SX.sym("touching_ground", 3, len(round_ones))
    planes = SX(ground)
    planes[:, round_ones] = at_touching
    planes[0, round_ones] += ca.sum1(at_touching[1:, :] * (places[:, round_ones] - touching))
    given = {"places": places, "ground": ground, "touching": touching, "touching_ground": at_touching}
    return traced("planes", {name: ca.vec(value) for name, value in given.items()}, {"ground_next": ca.vec(planes)})


def hull_places_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace x and y of the points of hulls: inputs of `places_function` -> `hull_places`, shape (2 n_points,)."""
    given, kinematics = _posed(mechanism, options)
    return traced("hull_places", given, {"hull_places": ca.vec(_hull_points(options, kinematics)[:2, :])})


def hulls_function(mechanism: Mechanism, options: StepOptions) -> ca.Function:
    """Trace the points where hulls touch the ground, appended to the contacts.

    Returns:
        Function (q, contact_places, contact_ground, hull_ground), or with `dependent` as for `places_function`, ->
        (places, ground, region_points). The results are x and y of contacts and of regions of hulls [m], shape
        (2 n_touches,); the ground under each, shape (3 n_touches,); and the points of regions that touch the ground, in
        axes of their bodies [m], shape (3 n_regions,).
    """
    given, kinematics = _posed(mechanism, options)
    points, n = _hull_points(options, kinematics), len(options.contacts)
    at, ground = SX.sym("contact_places", 2, n), SX.sym("contact_ground", 3, n)
    under, region_points = SX.sym("hull_ground", 3, points.shape[1]), []
    places, planes, first = [at], [ground], 0
    for hull in options.hulls:
        part = slice(first, first + len(hull.points))
        first = part.stop
        body = kinematics.bodies[hull.body]
        for spot, depth, normal in hull_contacts(hull, body.R[2, :].T, points[2, part], under[:, part], ground[0, :]):
            place = body.point_position(spot)
            region_points.append(spot)
            places.append(place[:2])
            planes.append(ca.vertcat(place[2] + depth / normal[2], -normal[:2] / normal[2]))
    given |= {"contact_places": ca.vec(at), "contact_ground": ca.vec(ground), "hull_ground": ca.vec(under)}
    results = {
        "places": ca.horzcat(*places),
        "ground_next": ca.horzcat(*planes),
        "region_points": ca.horzcat(*region_points),
    }
    return traced("hulls", given, {name: ca.vec(value) for name, value in results.items()})


def _hull_points(options: StepOptions, kinematics: Kinematics) -> SX:
    return _in_world(kinematics, [(hull.body, np.array(point)) for hull in options.hulls for point in hull.points])


def _in_world(kinematics: Kinematics, points: list[tuple[str, np.ndarray]]) -> SX:
    """Return the world coordinates of points of bodies [m], shape (3, n)."""
    return ca.horzcat(SX(3, 0), *[kinematics.bodies[body].point_position(constant(at)) for body, at in points])


def _posed(mechanism: Mechanism, options: StepOptions) -> tuple[dict[str, SX], Kinematics]:
    """Return symbols for positions, and guesses of dependent coordinates if there are any, and the kinematics."""
    state = symbolic_state(mechanism, options)
    kinematics = outward_velocity_pass(mechanism, state.q, SX(*state.v.shape), state.dependent)
    return {name: value for name, value in state.items() if name in ("q", "dependent")}, kinematics


def _spheres(mechanism: Mechanism, options: StepOptions) -> tuple[SX, list[int], SX, SX]:
    """Return radii of round contacts and their numbers, and symbols for the places and the ground of all contacts."""
    spheres = contact_spheres(mechanism, options)
    radius = np.array([sphere.radius for sphere in spheres])
    round_ones = np.flatnonzero(radius + np.array([sphere.rim for sphere in spheres])).tolist()
    places, ground = SX.sym("places", 2, len(radius)), SX.sym("ground", 3, len(radius))
    return SX(ca.DM(radius[round_ones])).T, round_ones, places, ground
