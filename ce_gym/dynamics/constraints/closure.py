"""The dependent coordinates of a cluster with closed loops, as functions of the independent ones.

`q = B [y; z] + q0`: linear constraints are eliminated first. The remaining unknowns `z` are solved block by block: by a
formula (closed_form.py) if one exists, otherwise by a fixed number of Newton iterations from a guess that is part of a
simulation's state. Velocities follow by differentiating the rows that determine `z`, again block by block:

    Phi_z zd = -Phi_y yd,    Phi_z zdd = -Phi_y ydd - (second derivative of phi along [yd; zd])
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import casadi as ca
import numpy as np

from ce_gym.dynamics.algebra.spatial import SX
from ce_gym.dynamics.constraints.assembly import Assembler, nonlinear_rows
from ce_gym.dynamics.constraints.closed_form import (
    Sample,
    sine_coefficients,
    sine_derivatives,
    solve_block,
    solve_pair,
    solve_single,
)
from ce_gym.model.clusters import Cluster
from ce_gym.model.description import Robot
from ce_gym.model.mechanism import Mechanism

NEWTON_ITERATIONS = 3
"""Newton iterations that reach rounding error from the guess of the last step, for velocities too."""


@dataclass(frozen=True)
class Block:
    """Unknowns of a cluster that are solved together.

    Attributes:
        rows: Rows of `phi` that determine the unknowns.
        unknowns: Entries of `z`.
        formula: The unknowns as expressions of the cluster's symbols; None for Newton's method.
    """

    rows: tuple[int, ...]
    unknowns: tuple[int, ...]
    formula: tuple[SX, ...] | None


class Closure:
    """The solution of one cluster's closed loops.

    Args:
        robot: The robot.
        cluster: A cluster of the robot with a nonlinear constraint.

    Attributes:
        assembly: The cluster at its reference pose.
        blocks: Blocks in the order of their solution.
        guessed: Entries of `z` that need a guess.
        locate: Function (y, guess) -> z, residual of the Newton blocks (largest absolute value).
        rates: Function (y, z, yd) -> G, g, nearness (see `ClusterCoordinates`).
        rows: Function (y, z) -> phi.

    Raises:
        RobotError: The loops do not close, or the independent joints do not determine the others.
    """

    def __init__(self, robot: Robot, cluster: Cluster) -> None:
        assembler = Assembler(robot, cluster)
        self.assembly = assembler.assemble()
        d, m = len(cluster.independent), len(self.assembly.unknown)
        self.y, self.z = SX.sym("y", d), SX.sym("z", m)
        self.phi = self._rows(robot, cluster)
        independent = [cluster.bodies.index(name) for name in cluster.independent]
        self.reference = self.assembly.q[[*independent, *self.assembly.unknown]]
        self.sample = Sample(ca.vertcat(self.y, self.z), self.reference)
        self.blocks = self._blocks()
        self.guessed = [j for block in self.blocks if block.formula is None for j in block.unknowns]
        self.rows = ca.Function("rows", [self.y, self.z], [self.phi])
        self.locate = self._locate()
        self.rates = self._rates()
        solution, _ = self.locate(self.reference[:d], self.guess)
        if not np.isfinite(solution.full()).all():  # at a dead centre rounding decides whether there is a solution
            raise assembler.singular()

    @property
    def guess(self) -> np.ndarray:
        """The unknowns that need a guess, at the reference pose."""
        return self.reference[[self.y.numel() + j for j in self.guessed]]

    def spanning(self, y: SX, z: SX) -> SX:
        """Return the spanning coordinates, shape (n,)."""
        return constant_matrix(self.assembly.B) @ ca.vertcat(y, z) + ca.DM(self.assembly.q0)

    def second_derivative(self, y: SX, z: SX, row: int) -> SX:
        """Return the second derivative by `y` of one spanning coordinate, shape (d, d); `g` is its form `yd^T H yd`."""
        yd = SX.sym("yd", y.numel())
        return ca.substitute(ca.hessian(self.rates(y, z, yd)[1][row], yd)[0] / 2, yd, SX.zeros(*yd.shape))

    def _rows(self, robot: Robot, cluster: Cluster) -> SX:
        rows = nonlinear_rows(robot, cluster, self.spanning(self.y, self.z))
        return rows[list(self.assembly.rows)]

    def _blocks(self) -> list[Block]:
        """Return the smallest groups of rows that can be solved one after the other."""
        pattern = np.array(ca.DM(ca.sparsify(ca.jacobian(self.phi, self.z)).sparsity(), 1).full()) != 0
        rows, known, blocks = list(range(len(pattern))), np.zeros(len(pattern), dtype=bool), []
        while rows:
            group, unknowns = _smallest_group(pattern, rows, known)
            blocks.append(Block(group, unknowns, self._formula(group, unknowns)))
            rows = [row for row in rows if row not in group]
            known[list(unknowns)] = True
        return blocks

    def _formula(self, rows: tuple[int, ...], unknowns: tuple[int, ...]) -> tuple[SX, ...] | None:
        phi, z = [self.phi[row] for row in rows], [self.z[j] for j in unknowns]
        if len(rows) == 1:
            single = solve_single(phi[0], z[0], self.sample)
            return None if single is None else (single,)
        return solve_pair((phi[0], phi[1]), (z[0], z[1]), self.sample) if len(rows) == 2 else None

    def _locate(self) -> ca.Function:
        guess = SX.sym("guess", len(self.guessed))
        z, gap = SX.zeros(self.z.numel(), 1), SX(0)
        for block in self.blocks:
            unknowns = list(block.unknowns)
            if block.formula is not None:
                z[unknowns] = ca.substitute(ca.vertcat(*block.formula), self.z, z)
                continue
            z[unknowns] = guess[[self.guessed.index(j) for j in unknowns]]
            phi = self.phi[list(block.rows)]
            newton = ca.Function("newton", [self.y, self.z], [phi, ca.jacobian(phi, self.z[unknowns])])
            for _ in range(NEWTON_ITERATIONS):
                value, slope = newton(self.y, z)
                z[unknowns] -= solve_block(slope, value)[0]
            gap = ca.fmax(gap, ca.norm_inf(newton(self.y, z)[0]))
        return ca.Function("locate", [self.y, guess], [z, gap])

    def _rates(self) -> ca.Function:
        """Differentiate the rows, block by block."""
        d, m = self.y.numel(), self.z.numel()
        yd, zd = SX.sym("yd", d), SX.sym("zd", m)
        at, speed = ca.vertcat(self.y, self.z), ca.vertcat(yd, zd)
        slope, bias = self._derivatives(at, speed)
        J, j, nearness = SX.zeros(m, d), SX.zeros(m, 1), SX(1)
        solved_before: list[int] = []
        for block in self.blocks:
            rows, mine = list(block.rows), [d + i for i in block.unknowns]
            right = ca.horzcat(slope[rows, :d], bias[rows])
            if solved_before:
                known = ca.horzcat(J[solved_before, :], j[solved_before])
                right += slope[rows, [d + i for i in solved_before]] @ known
            solved_before += block.unknowns
            solved, determinant = solve_block(slope[rows, mine], -right)
            J[list(block.unknowns), :], j[list(block.unknowns)] = solved[:, :d], solved[:, d]
            relative = determinant / self.sample.at_reference(determinant)
            nearness = ca.fmin(nearness, ca.if_else(relative > -1.0, relative, -1.0))  # -1 where it is not a number
        B, eye = constant_matrix(self.assembly.B), SX.eye(d)
        G = B @ ca.vertcat(eye, J)
        g = ca.substitute(B @ ca.vertcat(SX(d, 1), j), zd, ca.densify(J @ yd))
        return ca.Function("rates", [self.y, self.z, yd], [ca.densify(G), ca.densify(g), nearness])

    def _derivatives(self, at: SX, speed: SX) -> tuple[SX, SX]:
        """Return the slope of the rows (m, d + m) and their second derivative along a speed (m,), in the shorter form.

        A row solved by a sine can also be differentiated as a sine; the form that needs fewer instructions is used.
        """
        d, slope = self.y.numel(), ca.jacobian(self.phi, at)
        bias = ca.jtimes(slope @ speed, at, speed)
        for block in self.blocks:
            if len(block.rows) > 1 or block.formula is None:
                continue
            (row, j), formula = (*block.rows, *block.unknowns), ca.vertcat(*block.formula)
            coefficients = sine_coefficients(self.phi[row], self.z[j], self.sample)
            if coefficients is None:
                continue
            others = [i for i in range(at.numel()) if i != d + j]
            along, across, second = sine_derivatives(coefficients, self.z[j], speed[d + j], at[others], speed[others])
            alternative = SX.zeros(1, at.numel())
            alternative[0, others], alternative[0, d + j] = along, across
            forms = [(slope[row, :], bias[row]), (alternative, second)]
            costs = [_cost([formula, *ca.substitute(list(form), [self.z[j]], [formula])]) for form in forms]
            if costs[1] < costs[0]:
                slope[row, :], bias[row] = forms[1]
        return slope, bias


def _cost(expressions: list[SX]) -> int:
    """Return the number of instructions of expressions evaluated together."""
    shared = ca.cse([ca.densify(expression) for expression in expressions])
    return ca.Function("cost", [ca.vertcat(*ca.symvar(ca.vertcat(*map(ca.vec, shared))))], shared).n_instructions()


def _smallest_group(pattern: np.ndarray, rows: list[int], known: np.ndarray) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the fewest rows with as many unknowns as rows, and those unknowns."""
    for count in range(1, len(rows) + 1):
        for group in combinations(rows, count):
            unknowns = np.flatnonzero(pattern[list(group)].any(axis=0) & ~known)
            if len(unknowns) == count:
                return group, tuple(int(j) for j in unknowns)
    raise AssertionError("independent rows always determine as many unknowns")


def constant_matrix(x: np.ndarray) -> SX:
    """Return a numeric matrix as a sparse SX."""
    return ca.sparsify(SX(ca.DM(x)))


@lru_cache(maxsize=64)
def closures(mechanism: Mechanism) -> tuple[Closure | None, ...]:
    """Return the closure of each cluster of a mechanism; None where all constraints are linear.

    Raises:
        RobotError: Loops do not close, or independent joints do not determine the others.
    """
    robot = mechanism.robot
    return tuple(None if cluster.linear else Closure(robot, cluster) for cluster in mechanism.tree.clusters)


def reference_guess(mechanism: Mechanism) -> np.ndarray:
    """Return the dependent coordinates that Newton's method must guess, at the reference pose, shape (n_guess,)."""
    return np.concatenate([np.zeros(0), *[closure.guess for closure in closures(mechanism) if closure is not None]])


def loop_report(mechanism: Mechanism) -> str:
    """Return one line for each cluster with closed loops: its solution method and condition number."""
    lines = []
    for cluster, closure in zip(mechanism.tree.clusters, closures(mechanism), strict=True):
        if closure is not None:
            by_formula = sum(len(block.unknowns) for block in closure.blocks if block.formula is not None)
            lines.append(
                f"loops of {', '.join(tie.name for tie in cluster.constraints)}: {by_formula} joints by formula, "
                f"{len(closure.guessed)} by iteration, {closure.assembly.dropped} redundant rows dropped, "
                f"condition number {closure.assembly.condition:.3g} for {', '.join(cluster.independent)}"
            )
    return "\n".join(lines)
