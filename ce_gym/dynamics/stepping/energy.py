"""Mechanical energy of a robot in a scene: kinetic, potential and elastic.

Without motors nothing in the scene can give energy to the robot, so this sum must not grow.
"""

from __future__ import annotations

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.scene import Scene
from ce_gym.dynamics.laws.law import Start
from ce_gym.dynamics.laws.scene_laws import scene_laws
from ce_gym.dynamics.recursion.derived import kinetic_and_potential
from ce_gym.dynamics.state import State


def mechanical_energy(scene: Scene, state: State, target: SX) -> SX:
    """Return the kinetic and potential energy of the robot, and the energies of all force laws [J].

    Args:
        scene: The robot and its surroundings.
        state: Of the robot.
        target: Targets or torques in the order of `target_names`, shape (n_targets,).
    """
    start = Start(scene, state, target, 0.0)
    total = sum(kinetic_and_potential(scene.mechanism, state.q, state.v, state.dependent), SX(0))
    return sum((law.energy(start) for law in scene_laws(scene.mechanism, scene.options)), total)
