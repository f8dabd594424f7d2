"""The protocol of force laws: memory, iterate, and a force that is linear in the accelerations.

A contact acts or not, sticks or slips, a motor is at a limit or not: an active set. A law linearises its force about an
iterate, which assumes an active set. Given the resulting accelerations, the linear force checks that assumption and
returns the next iterate. This is Newton's method on the implicit step.

    placed = law.place(start)            evaluate depths, distances and speeds at the start of the step
    force = placed.linearise(iterate)    assume an active set
    force.add_to(loads)                  add the force to the equations of motion
    force.check(motion)                  compare the assumption with the accelerations
    force.next_iterate(motion, ...)      return the next assumption
    force.advance(motion)                return the memory at the end of the step
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.linear import JointForce, Motion
from ce_gym.dynamics.parameters import Parameter
from ce_gym.dynamics.recursion.ce_aba import BodyTerms
from ce_gym.dynamics.recursion.kinematics import Kinematics, outward_velocity_pass
from ce_gym.dynamics.state import Field, Output, State
from ce_gym.model.mechanism import Mechanism

if TYPE_CHECKING:
    from ce_gym.dynamics.forces.contact import Contact, LinearContact
    from ce_gym.dynamics.forces.saturation import Stick
    from ce_gym.dynamics.forces.scene import Scene, StepOptions
    from ce_gym.dynamics.forces.self_collision import LinearPair


@dataclass
class Start:
    """A robot at the start of a step.

    Attributes:
        scene: The robot and its surroundings.
        state: Of the robot.
        target: Targets or torques in the order of `target_names`, shape (n_targets,).
        dt: Length of the step [s]; the number 0 for the acceleration of the moment.
    """

    scene: Scene
    state: State
    target: SX
    dt: float

    @cached_property
    def kinematics(self) -> Kinematics:
        """Transforms and velocities of all bodies."""
        return outward_velocity_pass(self.scene.mechanism, self.state.q, self.state.v, self.state.dependent)

    @property
    def y(self) -> SX:
        """Positions of the independent joints and stretches [rad or m], shape (nj,)."""
        return self.state.q[self.scene.mechanism.robot.layout.joints_q :]

    @property
    def yd(self) -> SX:
        """Velocities of the independent joints and stretches, shape (nj,)."""
        return self.state.v[self.scene.mechanism.robot.layout.joints_v :]


@dataclass
class Loads:
    """Forces in the equations of motion, linear in the accelerations.

    The force on a body is `force - inertia @ a`, with `a` the acceleration of the body minus gravity, in its own axes;
    the force on coordinates is `tau - slope @ ydd`. Slopes come from taking a force one step
    ahead: `dt` times a damping, for example.

    Attributes:
        bodies: Terms of bodies by name.
        balls: Forces on ball joints.
        joints: Forces on joints with one coordinate.
        gravity: Acceleration of free fall, world axes, shape (3,).
        contacts: Forces on points of bodies.
        pairs: Forces between two bodies, unknown until the recursion has run.
    """

    bodies: dict[str, BodyTerms]
    balls: JointForce
    joints: JointForce
    gravity: SX
    contacts: list[LinearContact] = field(default_factory=list)
    pairs: list[LinearPair] = field(default_factory=list)


class LinearForce:
    """A force that is linear in the accelerations, for one active set.

    Attributes:
        contacts: Forces on points of bodies in it.
        sticks: Dry friction of joints and rotors in it.
    """

    contacts: Sequence[LinearContact] = ()
    sticks: Sequence[Stick] = ()

    def add_to(self, loads: Loads) -> None:
        """Add the force to the equations of motion, in place."""
        raise NotImplementedError

    def check(self, motion: Motion) -> SX | None:
        """Return 1 if the active set differs from the assumed one, else 0; None for a force without active set."""
        return None

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return the iterate for another iteration, shape (size,); a fixed point where `unconverged` is 0."""
        return SX(0, 1)

    def advance(self, motion: Motion) -> dict[str, SX]:
        """Return the law's fields at the end of the step; fields that are left out keep their values."""
        return {}

    def rates(self) -> dict[str, SX]:
        """Return time derivatives of fields that explicit methods integrate."""
        return {}

    def output(self, name: str, motion: Motion, after: State) -> SX:
        """Return an output of the law, given the state at the end of the step."""
        raise NotImplementedError(name)


class PlacedForce:
    """A force law at the start of a step.

    Attributes:
        culled: Contacts by culled group, see `stepping/broad_phase.py`.
    """

    culled: Mapping[str, Sequence[Contact]] = MappingProxyType({})

    def linearise(self, iterate: SX) -> LinearForce:
        """Linearise about an iterate, shape (size,)."""
        raise NotImplementedError


@dataclass
class PassiveForces(LinearForce, PlacedForce):
    """Forces on joints without memory or active set.

    Attributes:
        joints: On joints with one coordinate.
        balls: On ball joints.
    """

    joints: Sequence[JointForce] = ()
    balls: JointForce | None = None

    def linearise(self, iterate: SX) -> PassiveForces:
        """Return the forces, whatever the iterate."""
        return self

    def add_to(self, loads: Loads) -> None:
        """Add the forces to the joints."""
        loads.joints = sum(self.joints, loads.joints)
        loads.balls = loads.balls if self.balls is None else loads.balls + self.balls


@dataclass
class ForceLaw:
    """A force law in a scene: by default one without memory and without active set.

    Subclasses set the attributes that differ from these defaults in `declare`.

    Attributes:
        mechanism: The robot at a transmission level.
        options: The scene.
        acts: Whether the scene has such a force.
        fields: The law's memory.
        output_sizes: Sizes of the outputs by name.
        size: Size of the iterate; all zero at first.
        iterations: Number of further iterations of a step that the law may need.
        culled_rows: Rows of the iterate by culled group, see `stepping/broad_phase.py`.
    """

    mechanism: Mechanism
    options: StepOptions
    acts: bool = True
    fields: Sequence[Field] = ()
    output_sizes: Mapping[str, int] = field(default_factory=dict)
    size: int = 0
    iterations: int = 0
    culled_rows: Mapping[str, Sequence[int]] = field(default_factory=dict)

    parameters: ClassVar[tuple[Parameter, ...]] = ()
    """Parameters of the law; their values are in `Scene.values`."""
    outputs: ClassVar[tuple[Output, ...]] = ()
    """Quantities of the law that a step can report."""

    def __post_init__(self) -> None:
        self.declare()

    def declare(self) -> None:
        """Set the attributes of the law in its scene."""

    def place(self, start: Start) -> PlacedForce:
        """Return the law at the start of a step."""
        raise NotImplementedError

    def energy(self, start: Start) -> SX:
        """Return the potential energy of the force in a state [J]."""
        return SX(0)
