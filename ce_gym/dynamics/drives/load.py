"""What transmissions carry: the torque of a motor, and what all else does to its rotor.

The rest of the robot does to the coordinates of a cluster what its motion takes less what its motors give,

    external = D ydd - tau,    D = G^T H G of the articulated bodies beyond it, see ce_aba.py,

gravity, contacts, springs and the motion of what carries the cluster, but not its own inertia: of a pendulum gravity
alone. It goes to the rotors as torques do. Where a transmission stretches it is the torque of its mesh.

Friction under load goes by means over the last step: of one made in parts over the last part, of one made in stages
over its last stage, and within it over the stage before; what was refused leaves nothing. In further iterations, where
something asks for any, it goes by those of the last iteration in which motors stuck, slipped and were limited as they
were taken to be: a rotor that is wrongly taken to stick is stopped by a blow. That can be a step late, an error of
first order; so methods that extrapolate ask for a second iteration in every stage. Friction always takes energy,
whatever it goes by. Where there was no step before, rotors at rest are held in the first iteration, which tells what
it takes.
"""

from __future__ import annotations

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.electric.supply import Work
from ce_gym.dynamics.forces.actuation import Actuated, actuated_clusters, effort_matrix
from ce_gym.dynamics.forces.law import Motion
from ce_gym.dynamics.forces.motors import lagging_motors, loaded_motors, supply_of
from ce_gym.dynamics.forces.saturation import SaturatedForce
from ce_gym.dynamics.forces.scene import Scene, State
from ce_gym.dynamics.recursion.kinematics import Kinematics


def carried_now(state: State, iterate: SX) -> SX:
    """Return what friction goes by in an iteration, given what it went by in that before; as `State.carried` is."""
    return ca.if_else(iterate[-1] > 0, iterate, state.carried) if iterate.numel() else state.carried


def carried_after(
    scene: Scene, kinematics: Kinematics, motors: SaturatedForce, inertia: dict[int, SX], motion: Motion
) -> SX:
    """Return what is carried over a step whose acceleration is known, as `State.carried` is.

    Args:
        scene: The robot and what surrounds it.
        kinematics: At the start of the step.
        motors: What the motors deliver.
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
    """Return torques of motors at the end of a step whose acceleration is known, as `State.winding` is."""
    lagging = [motors.windings[i] for i in lagging_motors(scene.mechanism.robot, scene.options.motors)]
    return ca.vertcat(SX(0, 1), *[winding.tau - winding.slope @ motion.ydd for winding in lagging])


def supply_after(
    scene: Scene, kinematics: Kinematics, motors: SaturatedForce, motion: Motion, before: SX, yd: SX, dt: float
) -> SX:
    """Return temperatures and voltage after a step whose acceleration is known, as `State.supply` is.

    Args:
        scene: The robot and what surrounds it.
        kinematics: At the start of the step.
        motors: What the motors deliver.
        motion: The acceleration.
        before: As `State.supply` was.
        yd: Velocities of the independent joints at the start, shape (n,).
        dt: Length of the step [s].
    """
    robot, model = scene.mechanism.robot, scene.options.motors
    supply = supply_of(robot, model, before)
    clusters = actuated_clusters(scene.mechanism, kinematics) if before.numel() else ()
    work = {}
    for cluster in clusters:
        speed = cluster.W @ (yd + dt * motion.ydd)[cluster.rows]
        for i, (place, motor) in enumerate(zip(cluster.places, cluster.motors, strict=True)):
            torque = motors.windings[place].tau - motors.windings[place].slope @ motion.ydd
            full = scene.figures.strength * supply.line(place, motor)
            work[place] = Work(torque, speed[i], motors.on_line.get(place, SX(0)) * full)
    return ca.vertcat(SX(0, 1), *supply.after(robot.motors, work, dt))


def _external(cluster: Actuated, motors: SaturatedForce, inertia: SX, motion: Motion) -> SX:
    """Return what all else does to the rotors of a cluster [N m], shape (n_motors,)."""
    rows, d = cluster.rows, len(cluster.joints)
    ydd = motion.ydd[rows]
    on_rows = inertia @ ydd - (motors.tau[rows] - motors.slope[rows, rows] @ ydd)
    on_motors = effort_matrix(cluster.W[:, :d]) @ on_rows[:d]
    for i in range(len(cluster.motors)):
        stretch = ca.sparsify(cluster.W[i, d:])
        for column in stretch.sparsity().get_col():
            on_motors[i] = on_rows[d + column] / stretch[column]
    return on_motors
