"""The reference states of one file in tests/data/vectors, and models of the robot assembled as in each state.

The paper authors' library has its own order of bodies and its own choice of independent coordinates; both are taken
care of here, so that a test compares like with like: positions and velocities by name, and

    yd_theirs = T v,    ydd_theirs = T vdot + t,    tau = T^T tau_theirs.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from facts import load_facts

from ce_gym.dynamics import Model
from ce_gym.model import ContactSphere, Pose, Robot

Array = np.ndarray
DATA = Path(__file__).parents[1] / "data" / "vectors"
FILES = sorted(path.stem for path in DATA.glob("*.json") if path.stem != "ankle_tracking")


@dataclass
class Group:
    """States that one model is assembled like, in its coordinates.

    Attributes:
        model: The model.
        states: Which states of the file.
        q: Shape (n, nq).
        v: Shape (n, nv).
        T: Published independent velocities from ours, shape (n, nv, nv).
        t: Published independent accelerations at `vdot = 0`, shape (n, nv).
        columns: Rows of our spanning velocities in the published order.
    """

    model: Model
    states: list[int]
    q: Array
    v: Array
    T: Array
    t: Array
    columns: list[int]


class Vectors:
    """One file.

    Args:
        name: Of the file.
        make: Returns the robot, to be assembled as `pose` and `assembly` say; a body may have another name there.
        eliminate: Whether symmetric rotors are eliminated.
    """

    def __init__(self, name: str, make: Callable[[], Robot], eliminate: bool = True) -> None:
        self.data = json.loads((DATA / f"{name}.json").read_text())
        self.states, self.name = self.data["states"], name
        robot = make()
        self.free = robot.floating
        self.names = self._names(self.data["spanning_joint_order"], [body.name for body in robot.bodies])
        self.robot = replace(robot, contacts=self._contacts())
        assert list(robot.gravity) == self.data["gravity"]
        self.joints = [self.names[theirs] for theirs in self.data["spanning_joint_order"]][1 if self.free else 0 :]
        self.independent = self._independent()
        self.eliminate, self.models = eliminate, []
        assembled = [self._assembled_like(i) for i in range(len(self.states))]
        self.groups = [self._group(m, [i for i, n in enumerate(assembled) if n is m]) for m in self.models]

    def __getitem__(self, key: str) -> Array:
        """A quantity of all states that have it, which are the first ones."""
        return np.array([state[key] for state in self.states if key in state])

    def is_short(self, key: str) -> bool:
        """Whether the file lacks a quantity, which only files of scaling chains may."""
        missing = len(self[key]) == 0
        assert not missing or self.name.startswith(("bench_", "parallel_"))
        return missing

    def _names(self, theirs: list[str], ours: list[str]) -> dict[str, str]:
        """Our name of each of their bodies. Cranks are ours alone; branched chains are numbered differently."""
        assert len(set(theirs)) == len(theirs) <= len(ours)
        rest = theirs[1 if self.free else 0 :]
        if set(rest) <= set(ours):
            return dict(zip(theirs, [ours[0], *rest] if self.free else rest, strict=True))
        return dict(zip(theirs, ours, strict=True))

    def _contacts(self) -> tuple[ContactSphere, ...]:
        """Published contact points, in the order of the file."""
        order = self.data.get("contact_point_order") or []
        facts = {each["name"]: each for each in load_facts(self.name)["contact_points"]} if order else {}
        points = [facts[name] for name in order]
        return tuple(
            ContactSphere(p["name"], self.names[p["body"]], tuple(map(float, p["offset"])), 0.0) for p in points
        )

    def _independent(self) -> list[str]:
        """Our name of the joint that each of their independent velocities is, read off the velocities."""
        base = 6 if self.free else 0
        v_span, yd = self["v_span"][:, base:], self["yd"][:, base:]
        errors = np.abs(v_span[:, :, None] - yd[:, None, :]).max(axis=0)
        assert (errors.min(axis=0) <= 1e-12).all()
        return [self.joints[int(i)] for i in errors.argmin(axis=0)]

    def _assembled_like(self, state: int) -> Model:
        """Return a model on the branch of a state: one that is there already, if it will do."""
        angles = dict(zip(self.joints, self.states[state]["q_span"][7 if self.free else 0 :], strict=True))
        for model in self.models:
            if self._fits(model, state, angles):
                return model
        robot = self.robot
        if any(not hasattr(tie, "coefficients") for tie in robot.constraints):
            free, tied = (tuple((j, angles[j]) for j in angles if (j in robot.independent) == f) for f in (True, False))
            robot = replace(without_limits(robot), pose=Pose(joints=free), assembly=tied)
        self.models.append(Model(robot, eliminate_rotors=self.eliminate))
        assert self._fits(self.models[-1], state, angles), f"{self.name}: state {state} is not on any branch"
        return self.models[-1]

    def _fits(self, model: Model, state: int, angles: dict[str, float]) -> bool:
        q, v = self._ours(model, [state])
        try:
            found = dict(zip(model.spanning_names, model.spanning(q, v)[0][0, 7 if self.free else 0 :], strict=True))
        except ValueError:  # it does not get there
            return False
        return all(abs(np.exp(1j * found[joint]) - np.exp(1j * angle)) < 1e-6 for joint, angle in angles.items())

    def _ours(self, model: Model, states: list[int]) -> tuple[Array, Array]:
        """Positions and velocities of states in the coordinates of a model."""
        q_base, v_base = (7, 6) if self.free else (0, 0)
        columns = [self.joints.index(name) for name in model.joint_links]
        q = self["q_span"][states][:, [*range(q_base), *(q_base + i for i in columns)]]
        return q, self["v_span"][states][:, [*range(v_base), *(v_base + i for i in columns)]]

    def _group(self, model: Model, states: list[int]) -> Group:
        q, v = self._ours(model, states)
        G, g = model.explicit_constraint(q, v)
        base = 6 if self.free else 0
        columns = [*range(base), *(base + model.spanning_names.index(joint) for joint in self.joints)]
        mine = [*range(base), *(base + model.spanning_names.index(joint) for joint in self.independent)]
        return Group(model, states, q, v, G[:, mine], g[:, mine], columns)


def without_limits(robot: Robot) -> Robot:
    """Return a robot that may stand in any state of a file, which come from all round the circle."""
    free = [replace(body, joint=replace(body.joint, position=(-np.inf, np.inf))) for body in robot.bodies]
    return replace(robot, bodies=tuple(free))
