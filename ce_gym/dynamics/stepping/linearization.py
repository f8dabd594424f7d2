"""How one iteration of a step depends on the state before it, along many directions, as traced functions.

An iteration finds the acceleration at which the equation of motion `r(x, vdot) = 0` holds: inverse dynamics less the
forces of contacts, motors and joints. So along a direction `dx`

    dvdot = -A^-1 (dr/dx) dx,    A = dr/dvdot,

and only `r` is differentiated, never the recursion that solves it. `A`, the mass matrix and all that is implicit, is as
sparse as the tree of joints, and is factorised once, tips first, which fills nothing in. Derivatives of contact forces
with respect to where contacts are and how they move are shared by all directions. The damping of joints on turning
bodies contains inertias that clusters have on the way of the recursion; these change as found in reverse mode.

An iteration passes on to the next what velocities gained in it: that is another direction of the next one. (Torques of
dry friction that the iterations do not settle, see dry_friction.py, count as constant.)

Source: Carpentier, Mansard, "Analytical Derivatives of Rigid Body Dynamics Algorithms", RSS 2018, for inverse dynamics;
Featherstone 2008, section 6.5, for the factorisation.
"""

from __future__ import annotations

from functools import cached_property
from itertools import accumulate, groupby
from typing import TypeAlias

import casadi as ca

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.algebra.tracing import traced
from ce_gym.dynamics.forces.scene import StepOptions
from ce_gym.dynamics.stepping.derivatives import iterations_of
from ce_gym.dynamics.stepping.equation import Direction, Equation, acts, packed, there
from ce_gym.dynamics.stepping.factors import factorised, solved_with
from ce_gym.dynamics.stepping.step import finish_step, solve
from ce_gym.model.mechanism import Mechanism

REMEMBERED = ("load", "anchor")
"""Parts of a state besides positions and velocities whose derivatives are not zero: what contacts remember."""
Block: TypeAlias = tuple[str, int, int]
"""Consecutive directions: name of the input, first place, and count."""


class Linearization(Equation):
    """The traced functions; their inputs and outputs are buffers by name.

    Args:
        mechanism: The robot at a transmission level.
        options: The scene.
        whole_state: Whether the state is all that a step hands on to the next, what contacts remember included, and
            not only positions and velocities.

    Attributes:
        remembered: Sizes of the memory in the state, by name.
        chained: Whether iterations pass something smooth on.
    """

    def __init__(self, mechanism: Mechanism, options: StepOptions, whole_state: bool = False) -> None:
        super().__init__(mechanism, options)
        known = dict(self.given.state.items())
        self.remembered = {name: known[name].numel() for name in REMEMBERED if whole_state and name in known}
        self.chained = bool(self.local) and iterations_of(mechanism, options) > 1

    @property
    def size(self) -> int:
        """Of the state, positions counted in their tangent space."""
        return 2 * self.nv + sum(self.remembered.values())

    @cached_property
    def groups(self) -> list[list[Direction]]:
        """Directions, those together that share work."""
        base = self.layout.base_nv
        groups = [[(name, i) for i in range(base)] for name in ("q", "v") if base]
        for start in range(base, self.nv, 3):
            groups.append([(name, i) for name in ("q", "v") for i in range(start, min(start + 3, self.nv))])
        others = self.remembered | {"target": self.given.target.numel()}
        return groups + [[(name, i) for i in range(n)] for name, n in others.items() if n]

    @cached_property
    def places(self) -> dict[str, int]:
        """First direction of each part of the state and of the target."""
        sizes = {"q": self.nv, "v": self.nv, **self.remembered, "target": self.given.target.numel()}
        return dict(zip((*sizes, "end"), accumulate(sizes.values(), initial=0), strict=True))

    @cached_property
    def _slope(self) -> SX:
        return self.tangent_after(ca.jacobian(self.end_values, self.vdot))

    @cached_property
    def _factor(self) -> ca.Sparsity:
        return factorised(self.implicit(), self.order).sparsity()

    def iteration_function(self) -> ca.Function:
        """Trace an iteration, and the part of its derivative that all directions share.

        Returns:
            Function (*state, diverged, *given, iterate) -> (vdot, diverged, iterate, unconverged, factor, inertia,
            forces, slopes); empty outputs are left out here and below.
        """
        given = self.given
        solved = solve(given.scene, given.state, given.target, given.dt, self.iterate)
        after = finish_step(solved)
        forces, *slopes = [self.force_values, *[slope for _, _, slope in self.local]]
        forces, *slopes = [ca.substitute(x, self.vdot, solved.vdot) for x in (forces, *slopes)]
        left = {"vdot": solved.vdot, "diverged_next": given.guarded(after)["diverged_next"]}
        left |= {"iterate_next": after.iterate, "unconverged": after.unconverged} if self.iterate.numel() else {}
        left |= {
            "factor": packed(factorised(self.implicit(), self.order)),
            "inertia": self.stacked_inertias(self.articulated),
        }
        left |= {"contact_acts": acts(self.system.contacts)} if self.local else {}
        left |= {"forces": ca.vec(forces), "slopes": ca.vertcat(SX(0, 1), *map(packed, slopes))}
        return traced("iteration", {name: x for name, x in self.inputs.items() if name != "vdot"}, there(left))

    def drift_function(self) -> ca.Function:
        """Trace how the damping of joints on turning bodies changes because the inertias in it do, without contacts.

        Returns:
            Function (*inputs) -> drift, the derivative of that torque by itself.
        """
        free = ca.project(self.drift_of(self.inertias([])), self.drift.sparsity())
        return traced("drift", self.inputs, {"drift": packed(free)})

    def pressed_drift_function(self) -> ca.Function:
        """Trace the same with contacts.

        Returns:
            Function (*inputs, contact_acts, drift) -> drift, as it was for a robot that nothing touches.
        """
        before, acting = packed(self.drift), SX.sym("contact_acts")
        drift = ca.if_else(acting, packed(self.drift_of(self.articulated)), before)
        return traced("drift", self.inputs | {"contact_acts": acting, "drift": before}, {"drift_next": drift})

    def change_function(self, group: list[Direction]) -> ca.Function:
        """Trace how the equation of motion changes along directions, for an unchanged acceleration.

        Returns:
            Function (*inputs, inertia, forces, slopes, drift) -> a column (nv,) for each direction, block by block.
        """
        columns = self.to_own_axes(group, self.change(self.seeds(group)))
        return traced("change", self.frozen, in_blocks("change", group, columns))

    def press_function(self, group: list[Direction]) -> ca.Function | None:
        """Trace what contacts add to that; to be called if a contact acts.

        Returns:
            Function (*inputs, forces, slopes, columns of changes) -> the changes with contacts; None if they add none.
        """
        columns = self.to_own_axes(group, self.pressing(self.seeds(group)))
        if not columns.nnz():
            return None
        added = in_blocks("change", group, columns)
        changes = {name: SX.sym(name, column.numel()) for name, column in added.items()}
        left = {f"{name}_next": change + added[name] for name, change in changes.items()}
        return traced("press", self.frozen | changes, left)

    def solve_function(self, first: bool = False) -> ca.Function:
        """Trace how the acceleration changes along one direction.

        Returns:
            Function (factor, change, active, column) -> column (nv,), as it was where `active` is 0; in the first
            iteration (factor, change) -> column.
        """
        change, column, active = SX.sym("change", self.nv), SX.sym("column", self.nv), SX.sym("active")
        factor = SX.sym("factor", self._factor.nnz())
        solved = solved_with(SX(self._factor, factor), self.order, -change)
        given = {"factor": factor, "change": change}
        if first:
            return traced("solve", given, {"column": solved})
        given |= {"active": active, "column": column}
        return traced("solve", given, {"column_next": ca.if_else(active, solved, column)})

    def slope_function(self) -> ca.Function:
        """Trace how the state after the step changes with the acceleration.

        Returns:
            Function (*inputs) -> slope; and how it changes with gains of the iteration before, if those are kept.
        """
        left = {"slope": packed(self._slope)} | ({"end_gained": packed(self._end_gained)} if self.keeps_gains else {})
        return traced("slope", self.inputs, left)

    def end_function(self) -> ca.Function:
        """Trace how the state after the step changes along one direction.

        Returns:
            Function (slope, column, still, diverged, gains) -> that, positions in their tangent space, (size,); 0 for a
            robot that has diverged. Only loads depend on gains, of the iteration before the last.
        """
        slope, column = SX.sym("slope", self._slope.nnz()), SX.sym("column", self.nv)
        given, end = {"slope": slope, "column": column}, SX(self._slope.sparsity(), slope) @ column
        given |= {"still": SX.sym("still", self.size), "diverged": SX.sym("diverged")}
        if self.keeps_gains:
            given |= {
                "end_gained": SX.sym("gained", self._end_gained.nnz()),
                "gains": SX.sym("gains", self.wrt["gains"].numel()),
            }
            end += SX(self._end_gained.sparsity(), given["end_gained"]) @ given["gains"]
        return traced("end", given, {"end": ca.if_else(given["diverged"], 0, end + given["still"])})

    def still_function(self, group: list[Direction]) -> ca.Function:
        """Trace how the state after the step changes along directions for an unchanged acceleration.

        Returns:
            Function (*inputs) -> a column (size,) for each direction, block by block.
        """
        columns = self.to_own_axes(group, ca.jtimes(self.end_values, self.x, self.seeds(group)))
        return traced("still", self.inputs, in_blocks("still", group, self.tangent_after(columns)))

    def gains_function(self) -> ca.Function:
        """Trace the changes of the gains in velocity, which an iteration passes to the next.

        Returns:
            Function (*inputs of the one before, slopes, drift) -> (how gains change with accelerations, how the
            equation of motion changes with gains, and the gains' own change for each direction of the state).
        """
        left = {"gained": packed(self._gained), "into": packed(self._into)}
        for g, group in enumerate(self.groups):
            direct = self.to_own_axes(group, ca.jtimes(self._gains, self.x, self.seeds(group)))
            left |= in_blocks(f"direct{g}_", group, direct)
        return traced("gains", self.frozen, left)

    def pass_on_function(self) -> ca.Function:
        """Trace the effect of the iteration before on the equation of motion along one direction.

        Returns:
            Function (gained, into, direct, column, change) -> change (nv,), given the column of the one before; if
            gains are kept, (..., active, gains) -> (change, gains), those as they were where `active` is 0.
        """
        gained, into = SX.sym("gained", self._gained.nnz()), SX.sym("into", self._into.nnz())
        direct = SX.sym("direct", self._gains.numel())
        column, change = SX.sym("column", self.nv), SX.sym("change", self.nv)
        gains = direct + SX(self._gained.sparsity(), gained) @ column
        given = {"gained": gained, "into": into, "direct": direct, "column": column, "change": change}
        left = {"change_next": change + SX(self._into.sparsity(), into) @ gains}
        if self.keeps_gains:
            given |= {"active": SX.sym("active"), "gains": SX.sym("gains", gains.numel())}
            left["gains_next"] = ca.if_else(given["active"], gains, given["gains"])
        return traced("pass_on", given, left)

    @property
    def keeps_gains(self) -> bool:
        """Whether the state after the step depends on gains of the iteration before by more than the acceleration."""
        return self.chained and bool(self._end_gained.nnz())

    @cached_property
    def _end_gained(self) -> SX:
        after = self.tangent_after(ca.jacobian(self.end_values, self.wrt.get("gains", SX(0, 1))))
        return ca.sparsify(after)

    @cached_property
    def _gains(self) -> SX:
        return ca.vertcat(*[contact.gain(self.solved.motion) for contact in self.system.contacts])

    @cached_property
    def _gained(self) -> SX:
        return ca.sparsify(ca.jacobian(self._gains, self.vdot))

    @cached_property
    def _into(self) -> SX:
        n, m = self.x.numel(), self._gains.numel()
        seeds = SX(n, m)
        seeds[n - m :, :] = SX.eye(m)  # gains of the iteration before are the last that directions are changes of
        return ca.sparsify(self.change(seeds) + self.pressing(seeds))


def blocks(group: list[Direction]) -> list[Block]:
    """Return a group of directions as blocks of consecutive places in one input."""
    parts = [(name, [i for _, i in some]) for name, some in groupby(group, lambda direction: direction[0])]
    return [(name, places[0], len(places)) for name, places in parts]


def in_blocks(name: str, group: list[Direction], columns: SX) -> dict[str, SX]:
    """Return the columns of a group of directions, stacked for each block; names contain the sizes."""
    counts = [count for _, _, count in blocks(group)]
    split = ca.horzsplit(ca.densify(columns), list(accumulate(counts, initial=0)))
    return {f"{name}{j}_{count}": ca.vec(x) for j, (x, count) in enumerate(zip(split, counts, strict=True))}
