"""Loads of motors: the torque of each motor, and the torque of the rest of the robot on its rotor.

The rest of the robot acts on the coordinates of a cluster with the inertia forces less the torques of the motors,

    external = D ydd - tau,    D = G^T H G of the articulated bodies beyond it, see ce_aba.py:

gravity, contacts, springs and the motion of the carrier, but not the cluster's own inertia. For a pendulum this is
gravity alone. These forces act on rotors as joint torques do. Where a transmission stretches, the load is the torque of
its mesh.

Friction under load is computed from mean loads over the last step: over the last part of a step made in parts, over
the last stage of a step made in stages, and within a step over the stage before. Refused steps leave no load. Further
iterations use the loads of the last iteration whose active set of the motors was right, because a rotor that is wrongly
assumed to stick is stopped by a large torque. The load can be late by a step, an error of first order; so methods that
extrapolate need a second iteration in every stage. Friction always removes energy, whatever its load. Where there was
no step before, rotors at rest are held in the first iteration, which gives the load.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.electric.supply import Supply, Work
from ce_gym.dynamics.forces.actuation import Actuated, actuated_clusters, effort_matrix
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.motors import lagging_motors, loaded_motors
from ce_gym.dynamics.forces.saturation import SaturatedForce
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.dynamics.recursion.kinematics import Kinematics
from ce_gym.model.mechanism import Mechanism


def carried_now(before: SX, iterate: SX) -> SX:
    """Return the field `motor_load` for an iteration, given the field before the step and the last iterate."""
    return ca.if_else(iterate[-1] > 0, iterate, before) if iterate.numel() else before


def carried_after(
    scene: Scene, kinematics: Kinematics, motors: SaturatedForce, inertia: dict[int, SX], motion: Motion
) -> SX:
    """Return the field `motor_load` after a step whose acceleration is known.

    Args:
        scene: The robot and its surroundings.
        kinematics: At the start of the step.
        motors: Torques of the motors.
        inertia: Of clusters, without what acts on their coordinates, shape (d, d) each.
        motion: The acceleration.
    """
    places = loaded_motors(scene.mechanism.robot, scene.options.motors)
    own, other = SX(len(places), 1), SX(len(places), 1)
    for cluster in actuated_clusters(scene.mechanism, kinematics) if places else ():
        external = _external(cluster, motors, inertia[cluster.index], motion)
        for i, place in enumerate(cluster.places):
            if place in places:
                winding = motors.windings[place]
                own[places.index(place)] = winding.tau - winding.slope @ motion.ydd
                other[places.index(place)] = external[i]
    return ca.vertcat(own, other, 1) if places else SX(0, 1)


def windings_after(scene: Scene, motors: SaturatedForce, motion: Motion) -> SX:
    """Return the field `lagging_torque` after a step whose acceleration is known."""
    lagging = [motors.windings[i] for i in lagging_motors(scene.mechanism.robot, scene.options.motors)]
    return ca.vertcat(SX(0, 1), *[winding.tau - winding.slope @ motion.ydd for winding in lagging])


def motor_work(
    clusters: Sequence[Actuated], motors: SaturatedForce, supply: Supply, strength: SX, yd: SX, motion: Motion
) -> dict[int, Work]:
    """Return the work of each motor over a step, by its place.

    Args:
        clusters: With motors.
        motors: Torques of the motors.
        supply: Temperatures and voltage at the start of the step.
        strength: Factor on the torques of all motors [-].
        yd: Velocities of the independent joints at the end of the step, shape (nj,).
        motion: The acceleration.
    """
    work = {}
    for cluster in clusters:
        speed = cluster.W @ yd[cluster.rows]
        for i, (place, motor) in enumerate(zip(cluster.places, cluster.motors, strict=True)):
            torque = motors.windings[place].tau - motors.windings[place].slope @ motion.ydd
            full = strength * supply.line(place, motor)
            work[place] = Work(torque, speed[i], motors.on_line.get(place, SX(0)) * full)
    return work


def winding_torques(
    mechanism: Mechanism, kinematics: Kinematics, motors: SaturatedForce, torque: SX, motion: Motion
) -> SX:
    """Return the torque of each motor [N m], shape (n_motors,); of ideal motors the share of the joint torque."""
    torques = SX(len(mechanism.robot.motors), 1)
    for cluster in actuated_clusters(mechanism, kinematics):
        shares = effort_matrix(cluster.W[:, : len(cluster.joints)]) @ torque[cluster.joints]
        for i, place in enumerate(cluster.places):
            winding = motors.windings.get(place)
            torques[place] = shares[i] if winding is None else winding.tau - winding.slope @ motion.ydd
    return torques


def _external(cluster: Actuated, motors: SaturatedForce, inertia: SX, motion: Motion) -> SX:
    """Return the torques of the rest of the robot on the rotors of a cluster [N m], shape (n_motors,)."""
    rows, d = cluster.rows, len(cluster.joints)
    ydd = motion.ydd[rows]
    on_rows = inertia @ ydd - (motors.tau[rows] - motors.slope[rows, rows] @ ydd)
    on_motors = effort_matrix(cluster.W[:, :d]) @ on_rows[:d]
    for i in range(len(cluster.motors)):
        stretch = ca.sparsify(cluster.W[i, d:])
        for column in stretch.sparsity().get_col():
            on_motors[i] = on_rows[d + column] / stretch[column]
    return on_motors
