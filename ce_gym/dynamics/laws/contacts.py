"""Contact of spheres, wheels and convex corners with the ground; `forces/contact.py` has the equations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import RELEASES, Compliance, Contact, LinearContact, touch_ground, where
from ce_gym.dynamics.forces.friction import FRICTION
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.normal import normal_law
from ce_gym.dynamics.forces.scene import Scene, contact_centres
from ce_gym.dynamics.hulls import with_hulls
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.parameters import Parameter
from ce_gym.dynamics.recursion.ce_aba import BodyTerms
from ce_gym.dynamics.recursion.kinematics import constant
from ce_gym.dynamics.state import Field, Output, State
from ce_gym.model.description import Robot

FOOT = "foot"
"""Group of the contacts that are always computed."""
MOST = 3
"""Most groups of contacts that are skipped each by itself; kernels branch for each."""
TWO_LOADS = ("extrapolated", "adaptive")
"""Methods that remember the normal forces of whole steps apart from those of half steps, see `methods.py`."""

SLIP_SPEED = "speed at which the damping of friction alone carries its full force"
DAMPING = "normal damping of the contacts under Kelvin and Voigt's law"


class Contacts(ForceLaw):
    """Contact of a robot with the ground."""

    parameters = (
        Parameter("friction", "Coulomb coefficient of the contacts", "-", "1", lambda _, x: [x.friction]),
        Parameter("slip_speed", SLIP_SPEED, "m/s", "1", lambda _, x: [x.slip_speed], "positive"),
        Parameter("stiffness", "normal stiffness of the contacts", "N/m", "1", lambda _, x: [x.stiffness]),
        Parameter("damping", DAMPING, "N s/m", "1", lambda _, x: [x.damping]),
    )
    outputs = (Output("contact_forces", "N", "force on each contact, world axes", "mean"),)

    def declare(self) -> None:
        """Remember normal forces, and deflections of bristles if the material has them."""
        options, n = self.options, len(self.options.touches)
        coarse = n if options.method in TWO_LOADS else 0
        bristles = 2 * n if options.material.bristle > 0 else 0
        self.acts = n > 0
        self.fields = (
            Field("load", n, "N", "normal force of each contact over the last step", "resting_load", True),
            Field("whole_load", coarse, "N", "normal force over the last whole step", "resting_load", True),
            Field("anchor", bristles, "m", "horizontal deflection of each bristle, world axes", explicit=True),
        )
        self.output_sizes = {"contact_forces": 3 * len(options.contacts)}
        self.size, self.iterations = Contact.size * n, FRICTION[options.friction].iterations + RELEASES
        self.groups = culled_groups(self.mechanism.robot, options.touches)
        self.culled_rows = {
            group: [Contact.size * i + j for i in places for j in range(Contact.size)]
            for group, places in self.groups.items()
        }

    def place(self, start: Start) -> PlacedContacts:
        """Place every contact against the ground."""
        contacts = contacts_at(start)
        culled = {group: [contacts[i] for i in places] for group, places in self.groups.items()}
        return PlacedContacts(start, contacts, culled)

    def energy(self, start: Start) -> SX:
        """Return the energy of the contacts' springs and bristles [J]."""
        return touch_energy(start, contacts_at(start))


@dataclass
class PlacedContacts(PlacedForce):
    """The contacts at the start of a step."""

    start: Start
    contacts: list[Contact]
    culled: dict[str, list[Contact]] = field()  # without the default of the base class

    def linearise(self, iterate: SX) -> ContactForces:
        """Linearise every contact about its part of the iterate."""
        parts = ca.vertsplit(iterate, Contact.size)
        linear = [contact.linearise(part) for contact, part in zip(self.contacts, parts, strict=True)]
        return ContactForces(self.start, linear, parts)


@dataclass
class ContactForces(LinearForce):
    """The forces of all contacts, linear in the accelerations."""

    start: Start
    contacts: list[LinearContact] = field()  # without the default of the base class
    iterates: list[SX]

    def add_to(self, loads: Loads) -> None:
        """Add the contacts to their bodies."""
        loads.contacts += self.contacts

    def check(self, motion: Motion) -> SX:
        """Return 1 if the active set of a contact has changed, else 0."""
        return any_changed(self.contacts, motion)

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return the iterates of all contacts; converged robots keep theirs, so that they repeat their result."""
        return iterates_after(self.contacts, self.iterates, motion, unconverged)

    def advance(self, motion: Motion) -> dict[str, SX]:
        """Return normal forces and deflections at the end of the step."""
        loads = [where(c.law.near, ca.fmax(c.load_after(c.gain(motion)), 0)) for c in self.contacts]
        after = {"load": ca.vertcat(*loads)}
        if self.start.state["anchor"].numel():
            after["anchor"] = ca.vertcat(
                *[where(c.law.near, c.anchor_after(c.gain(motion))[:2]) for c in self.contacts]
            )
        return after

    def rates(self) -> dict[str, SX]:
        """Return the rates of the bristles' deflections."""
        if not self.start.state["anchor"].numel():
            return {}
        slides = [ca.if_else(c.normal_slope > 0, c.sliding[:2], 0) for c in self.contacts]
        return {"anchor": ca.vertcat(*slides)}

    def output(self, name: str, motion: Motion, after: State) -> SX:
        """Return the mean force on each contact over the step, world axes [N], shape (3, n_contacts)."""
        forces = [where(c.law.near, c.force_after(c.gain(motion))) for c in self.contacts]
        return with_hulls(ca.horzcat(SX(3, 0), *forces), self.start.scene.options.hulls)


def culled_groups(robot: Robot, touches: Sequence[str]) -> dict[str, list[int]]:
    """Return the places of the contacts in each culled group: all but feet, the last group with those beyond `MOST`."""
    labels = {contact.name: contact.group for contact in robot.contacts}
    names = list(dict.fromkeys(labels[name] for name in touches if labels[name] != FOOT))
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(touches):
        if labels[name] != FOOT:
            groups.setdefault(names[min(names.index(labels[name]), MOST - 1)], []).append(i)
    return groups


def compliance_of(scene: Scene) -> Compliance:
    """Return the compliance of the contacts of a scene."""
    values, material = scene.values, scene.options.material
    dissipation = None if material.dissipation is None else SX(material.dissipation)
    names = ("stiffness", "damping", "friction", "slip_speed")
    return Compliance(dissipation=dissipation, bristle=SX(material.bristle), **{name: values[name] for name in names})


def contacts_at(start: Start) -> list[Contact]:
    """Place every contact of the scene against the plane tangent to the ground nearby."""
    scene, state, options = start.scene, start.state, start.scene.options
    normal, friction = normal_law(options.normal_law, options.material), FRICTION[options.friction]
    compliance, resolves = compliance_of(scene), METHODS[options.method].controlled
    contacts = []
    for i, (sphere, centre) in enumerate(contact_centres(scene)):
        body = start.kinematics.bodies[sphere.body]
        height, up = SX(0), constant(np.array([0.0, 0.0, 1.0]))
        if options.ground == "field":
            height, slope = scene.ground[0, i], scene.ground[1:, i]
            if scene.looked_up.numel():
                height += ca.dot(slope, body.point_position(centre)[:2] - scene.looked_up[:, i])
            up = ca.vertcat(-slope, 1) / ca.sqrt(1 + ca.sumsqr(slope))
        anchor = state["anchor"][2 * i : 2 * i + 2] if state["anchor"].numel() else state["anchor"]
        touch = touch_ground(body, sphere, centre, height, up, state["load"][i], anchor)
        contacts.append(Contact(sphere.body, touch, compliance, normal, friction, start.dt, resolves_landing=resolves))
    return contacts


def with_contacts(bodies: dict[str, BodyTerms], contacts: Sequence[LinearContact], gravity: SX) -> dict[str, BodyTerms]:
    """Return the terms of bodies with contacts added, given the acceleration of free fall in world axes, shape (3,)."""
    terms = dict(bodies)
    for contact in sorted(contacts, key=lambda contact: contact.law.near is None):  # sums of culled groups stand alone
        new, old = contact.body_terms(gravity), terms.get(contact.body)
        total, near = BodyTerms(old.inertia + new.inertia, old.force + new.force) if old else new, contact.law.near
        none = old or BodyTerms(SX(6, 6), SX(6, 1))
        terms[contact.body] = BodyTerms(where(near, total.inertia, none.inertia), where(near, total.force, none.force))
    return terms


def any_changed(contacts: Sequence[LinearContact], motion: Motion) -> SX:
    """Return 1 if the active set of a contact differs from the assumed one, else 0."""
    groups: dict[int, list[LinearContact]] = {}
    for contact in contacts:
        groups.setdefault(id(contact.law.near), []).append(contact)
    counts = [where(same[0].law.near, sum((c.check(motion) for c in same), SX(0))) for same in groups.values()]
    return sum(counts, SX(0)) > 0


def iterates_after(contacts: Sequence[LinearContact], iterates: list[SX], motion: Motion, unconverged: SX) -> SX:
    """Return the iterates of contacts for another iteration; robots that need no other keep theirs."""
    parts = [
        where(c.law.near, ca.if_else(unconverged, c.next_iterate(motion), part), part)
        for c, part in zip(contacts, iterates, strict=True)
    ]
    return ca.vertcat(*parts)


def touch_energy(start: Start, contacts: Sequence[Contact]) -> SX:
    """Return the energy of the springs and bristles of contacts [J]."""
    compliance = compliance_of(start.scene)
    k, bristle = compliance.stiffness, compliance.bristle
    touches = [contact.touch for contact in contacts]
    return sum((k * ca.fmax(t.depth, 0) ** 2 + bristle * ca.sumsqr(t.anchor) for t in touches), SX(0)) / 2
