"""Contact between the links of a robot; `forces/self_collision.py` has the equations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.forces.contact import Contact, where
from ce_gym.dynamics.forces.linear import Motion
from ce_gym.dynamics.forces.normal import normal_law
from ce_gym.dynamics.forces.self_collision import Frictionless, LinearPair, Pair, pair_between
from ce_gym.dynamics.integrators.methods import METHODS
from ce_gym.dynamics.laws.contacts import any_changed, compliance_of, iterates_after, touch_energy
from ce_gym.dynamics.laws.law import ForceLaw, LinearForce, Loads, PlacedForce, Start
from ce_gym.dynamics.state import Field
from ce_gym.model.checks.collisions import colliding

LINKS = "links"
"""Name of the culled group of all pairs."""


class LinkPairs(ForceLaw):
    """Pairs of capsules on links that push each other apart."""

    def declare(self) -> None:
        """Remember the force of each pair; pairs act only where they are near."""
        self.capsules = colliding(self.mechanism.robot, self.options.self_collisions)
        n = len(self.capsules)
        self.acts = n > 0
        meaning = "force between each pair of capsules over the last step"
        self.fields = (Field("pair_force", n, "N", meaning, explicit=True),)
        self.size, self.iterations = Contact.size * n, Frictionless.iterations
        self.culled_rows = {LINKS: range(self.size)} if n else {}

    def place(self, start: Start) -> PlacedPairs:
        """Place the capsules of every pair against each other."""
        pairs = self._pairs_at(start)
        return PlacedPairs(pairs, {LINKS: pairs})

    def energy(self, start: Start) -> SX:
        """Return the energy of the springs between links [J]."""
        return touch_energy(start, self._pairs_at(start))

    def _pairs_at(self, start: Start) -> list[Pair]:
        options, compliance, pairs = self.options, compliance_of(start.scene), []
        law = normal_law(options.normal_law, options.material)
        for i, pair in enumerate(self.capsules):
            bodies = start.kinematics.bodies[pair[0].body], start.kinematics.bodies[pair[1].body]
            pair_contact = pair_between(pair, bodies, start.state["pair_force"][i], compliance, law, start.dt)
            pairs.append(replace(pair_contact, resolves_landing=METHODS[options.method].controlled))
        return pairs


@dataclass
class PlacedPairs(PlacedForce):
    """The pairs at the start of a step."""

    pairs: list[Pair]
    culled: dict[str, list[Pair]] = field()  # without the default of the base class

    def linearise(self, iterate: SX) -> PairForces:
        """Linearise every pair about its part of the iterate."""
        parts = ca.vertsplit(iterate, Contact.size)
        return PairForces([pair.linearise(part) for pair, part in zip(self.pairs, parts, strict=True)], parts)


@dataclass
class PairForces(LinearForce):
    """The forces between links, linear in the accelerations of both."""

    pairs: list[LinearPair]
    iterates: list[SX]

    def add_to(self, loads: Loads) -> None:
        """Add the pairs, whose forces the recursion finds."""
        loads.pairs += self.pairs

    def check(self, motion: Motion) -> SX:
        """Return 1 if a pair acts that was assumed not to, or the reverse; else 0."""
        return any_changed(self.pairs, motion)

    def next_iterate(self, motion: Motion, unconverged: SX) -> SX:
        """Return the iterates of all pairs."""
        return iterates_after(self.pairs, self.iterates, motion, unconverged)

    def advance(self, motion: Motion) -> dict[str, SX]:
        """Return the forces at the end of the step."""
        forces = [where(p.law.near, ca.fmax(p.normal_after(p.gain(motion)), 0)) for p in self.pairs]
        return {"pair_force": ca.vertcat(*forces)}
