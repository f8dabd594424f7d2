"""Random robots for hypothesis: any tree, rotors on any carrier, gears, belts, differentials, four-bars and rods.

Hypothesis draws the parts of a robot and shrinks a failing robot to the smallest one; figures come from a seed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from dense import Dense
from hypothesis import strategies as st

from ce_gym.model import (
    Body,
    Constraint,
    Inertial,
    Joint,
    LinearConstraint,
    LoopConstraint,
    Placement,
    Pose,
    Robot,
    RodConstraint,
)

Vector = tuple[float, ...]

PIVOT = 0.2
"""Smallest pivot, relative to the other entries of its row, of a dependent coordinate: farther from singularities."""


@dataclass(frozen=True)
class Recipe:
    """The parts of a robot.

    Attributes:
        floating: Whether its base floats.
        parents: For each link, which of those before it carries it; the base or world is before all.
        prismatic: For each link, whether it slides.
        aligned: Whether axes and placements are along coordinate axes, so that much is zero.
        ties: "gear", "belt" over two joints, "differential" of two rotors over two joints, "coupling" of two links.
        rotors: For each rotor, in turn: "round" is symmetric about its axis, "flat" spins about a principal axis of an
            inertia that is not symmetric, "lopsided" about any axis beside its centre of mass.
        four_bar: Whether a four-bar hangs on a link; its crank has a rotor.
        rod: Whether a rod ties two bodies.
        shuffled: Whether independent coordinates are chosen at random, rotors included.
        seed: For the figures.
    """

    floating: bool
    parents: tuple[int, ...]
    prismatic: tuple[bool, ...]
    aligned: bool
    ties: tuple[str, ...]
    rotors: tuple[str, ...]
    four_bar: bool
    rod: bool
    shuffled: bool
    seed: int


@st.composite
def recipes(draw: st.DrawFn, loops: bool) -> Recipe:
    n = draw(st.integers(2, 4))
    ties = st.lists(st.sampled_from(["gear", "belt", "differential", "coupling"]), max_size=3)
    loop = draw(st.sampled_from([(True, False), (False, True), (True, True)])) if loops else (False, False)
    return Recipe(
        floating=draw(st.booleans()),
        parents=tuple(draw(st.integers(0, i)) for i in range(n)),
        prismatic=tuple(draw(st.lists(st.booleans(), min_size=n, max_size=n))),
        aligned=draw(st.booleans()),
        ties=tuple(draw(ties)),
        rotors=tuple(draw(st.lists(st.sampled_from(["round", "flat", "lopsided"]), min_size=6, max_size=6))),
        four_bar=loop[0],
        rod=loop[1],
        shuffled=draw(st.booleans()),
        seed=draw(st.integers(0, 2**32 - 1)),
    )


def build(recipe: Recipe) -> Robot:
    """Return the robot of a recipe, at a pose where its loops are closed and well away from singularities."""
    return _Builder(recipe).build()


def vector(x: np.ndarray) -> Vector:
    return tuple(map(float, x))


def matrix(x: np.ndarray) -> tuple[Vector, ...]:
    return tuple(map(vector, x))


class _Builder:
    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.rng = recipe, np.random.default_rng(recipe.seed)
        self.bodies: list[Body] = []
        self.ties: list[Constraint] = []
        self.start: dict[str, float] = {}

    def build(self) -> Robot:
        recipe = self.recipe
        if recipe.floating:
            self.bodies.append(self.body("base", None, "free"))
        root = "base" if recipe.floating else None
        carriers = [root]
        for i, (parent, slides) in enumerate(zip(recipe.parents, recipe.prismatic, strict=True)):
            self.add(self.body(f"link{i}", carriers[parent], "prismatic" if slides else "revolute"))
            carriers.append(f"link{i}")
        links = carriers[1:]
        for i, kind in enumerate(recipe.ties):
            self.transmit(f"{kind}{i}", kind, links, carriers)
        if recipe.four_bar:
            self.four_bar(str(self.rng.choice(links)))
        if recipe.rod:
            self.rod(carriers)
        return self.assembled()

    def add(self, body: Body, at: float | None = None) -> None:
        self.bodies.append(body)
        self.start[body.name] = self.rng.uniform(-1.0, 1.0) if at is None else at

    def body(self, name: str, parent: str | None, joint: str | Joint, **fields: object) -> Body:
        """A body with random figures, except the ones in `fields`."""
        spread = self.rng.uniform(0.01, 0.03, 3)
        A = np.eye(3) if self.recipe.aligned else self.rotation()
        inertia = A @ (np.diag(spread.sum() - spread)) @ A.T
        figures = Inertial(1.0 + self.rng.random(), vector(self.rng.normal(0, 0.1, 3)), matrix(inertia))
        place = Placement(vector(self.rng.normal(0, 0.2, 3)), matrix(self.rotation()))
        joint = joint if isinstance(joint, Joint) else Joint(joint, self.axis())  # type: ignore[arg-type]
        arguments = {"kind": "link", "placement": place, "joint": joint, "inertial": figures} | fields
        return Body(name, parent=parent, **arguments)  # type: ignore[arg-type]

    def axis(self) -> Vector:
        axis = np.eye(3)[self.rng.integers(3)] if self.recipe.aligned else self.rng.normal(size=3)
        return vector(axis / np.linalg.norm(axis))

    def rotation(self) -> np.ndarray:
        Q = np.eye(3)[self.rng.permutation(3)] if self.recipe.aligned else np.linalg.qr(self.rng.normal(size=(3, 3)))[0]
        return Q * np.linalg.det(Q)

    def rotor(self, name: str, carriers: list[str | None]) -> str:
        """A rotor on any carrier."""
        taken = sum(body.kind == "rotor" for body in self.bodies)
        carrier = carriers[self.rng.integers(len(carriers))]
        kind = self.recipe.rotors[taken % len(self.recipe.rotors)]
        axis = np.array(self.axis())
        inertia, com = 2e-3 * np.eye(3) + 1e-3 * np.outer(axis, axis), 0.02 * axis
        if kind == "flat":
            across = np.cross(axis, self.rng.normal(size=3))
            across /= np.linalg.norm(across)
            inertia += 8e-4 * (np.outer(across, across) - np.outer(axis, axis))
        elif kind == "lopsided":
            A = self.rng.normal(0, 0.02, (3, 3))
            spread = A @ A.T
            inertia, com = inertia + np.trace(spread) * np.eye(3) - spread, com + self.rng.normal(0, 0.01, 3)
        figures = Inertial(0.3, vector(com), matrix(inertia))
        self.add(self.body(name, carrier, Joint("revolute", vector(axis)), kind="rotor", inertial=figures))
        return name

    def transmit(self, name: str, kind: str, links: list[str], carriers: list[str | None]) -> None:
        chosen = [str(link) for link in self.rng.choice(links, 2, replace=False)]
        ratios = self.rng.uniform(1.5, 8.0, 2) * self.rng.choice([-1.0, 1.0], 2)
        if kind == "coupling":
            if any(isinstance(tie, LinearConstraint) and tie.name.startswith("coupling") for tie in self.ties):
                return  # two couplings could lock a robot
            self.tie(name, {chosen[0]: 1.0, chosen[1]: ratios[0] / 4.0})
            return
        for sign in (1.0, -1.0) if kind == "differential" else (1.0,):
            rotor = self.rotor(f"{name}_rotor{len(self.bodies)}", carriers)
            second = {} if kind == "gear" else {chosen[1]: sign * ratios[1]}
            self.tie(f"{rotor}_tie", {rotor: 1.0, chosen[0]: ratios[0]} | second)

    def tie(self, name: str, coefficients: dict[str, float]) -> None:
        offset = float(sum(coefficient * self.start[body] for body, coefficient in coefficients.items()))
        pairs = tuple((body, float(coefficient)) for body, coefficient in coefficients.items())
        self.ties.append(LinearConstraint(name, pairs, offset))

    def four_bar(self, carrier: str) -> None:
        """A planar crank, coupler and rocker on a link, closed by a hinge; a rotor drives the crank."""
        crank, coupler, ground, rocker = 0.15, 0.35, 0.3, 0.25
        angle = self.rng.uniform(0.5, 2.5)
        tip = crank * np.array([np.cos(angle), np.sin(angle)])
        across = np.array([ground, 0.0]) - tip
        span = np.linalg.norm(across)  # coupler, rocker and this line are a triangle
        lift = np.arccos((coupler**2 + span**2 - rocker**2) / (2 * coupler * span))
        along = np.arctan2(across[1], across[0]) + lift
        pin = tip + coupler * np.array([np.cos(along), np.sin(along)])
        swing = np.arctan2(pin[1], pin[0] - ground)
        frame = self.body("frame", carrier, "revolute").placement
        z = Joint("revolute", (0.0, 0.0, 1.0))
        R, p = np.array(frame.rotation), np.array(frame.position)
        shifted = replace(frame, position=vector(p + R @ [ground, 0.0, 0.0]))
        self.add(self.body("crank", carrier, z, placement=frame), angle)
        self.add(self.body("coupler", "crank", z, placement=Placement((crank, 0.0, 0.0))), along - angle)
        self.add(self.body("rocker", carrier, z, placement=shifted), swing)
        ends = Placement((coupler, 0.0, 0.0)), Placement((rocker, 0.0, 0.0))
        self.ties.append(LoopConstraint("pin", "revolute", "coupler", "rocker", *ends))
        self.tie("crank_tie", {self.rotor("crank_rotor", [carrier]): 1.0, "crank": -self.rng.uniform(2.0, 8.0)})

    def rod(self, carriers: list[str | None]) -> None:
        first, second = (carriers[i] for i in self.rng.choice(len(carriers), 2, replace=False))
        points = [vector(self.rng.normal(0, 0.2, 3)) for _ in range(2)]
        rod = RodConstraint("rod", first, second, *points, length=1.0)
        dense = self.dense(Robot("", tuple(self.bodies)))
        length = float(np.linalg.norm(dense.frame(first).at(points[0]).p - dense.frame(second).at(points[1]).p))
        self.ties.append(replace(rod, length=length))

    def dense(self, robot: Robot) -> Dense:
        base = 1 if self.recipe.floating else 0
        joints = [self.start[body.name] for body in robot.bodies if body.joint.type != "free"]
        return Dense(robot, np.array([*([0, 0, 0, 1, 0, 0, 0] * base), *joints]), np.zeros(len(joints) + 6 * base))

    def assembled(self) -> Robot:
        """Choose independent coordinates that determine the others well, by elimination with pivots."""
        robot = Robot("random", tuple(self.bodies), tuple(self.ties))
        dense = self.dense(robot)
        _, K, _ = dense.constraints()
        names = list(dense.columns)
        K = K[:, [dense.columns[name] for name in names]]
        order = list(self.rng.permutation(len(names)))
        if not self.recipe.shuffled:  # rotors and the ends of loops first
            last = [name.startswith("link") or name == "crank" for name in names]
            order.sort(key=lambda i: last[i])
        dependent = []
        while (rows := np.abs(K).max(axis=1, initial=0.0) > 1e-6).any():
            K = K[rows] / np.abs(K[rows]).max(axis=1, keepdims=True)
            column = next(i for i in order if (np.abs(K[:, i]) >= PIVOT).any())
            row = int(np.abs(K[:, column]).argmax())
            K = np.delete(K - np.outer(K[:, column], K[row] / K[row, column]), row, axis=0)
            dependent.append(names[column])
        independent = [names[i] for i in self.rng.permutation(len(names)) if names[i] not in dependent]
        return replace(
            robot,
            independent=tuple(independent),
            pose=Pose(joints=tuple((name, float(self.start[name])) for name in independent)),
            assembly=tuple((name, float(self.start[name])) for name in dependent),
        )
