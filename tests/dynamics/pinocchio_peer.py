"""The spanning tree of a robot in Pinocchio, for tests where it is installed."""

from __future__ import annotations

import numpy as np

from ce_gym.model import Body, Robot

Array = np.ndarray


class Peer:
    """A robot without its constraints; all quantities in the order of `Model.spanning`."""

    def __init__(self, robot: Robot) -> None:
        import pinocchio as pin

        self.pin, self.robot, self.model = pin, robot, pin.Model()
        self.model.gravity = pin.Motion(np.array(robot.gravity), np.zeros(3))
        self.joints: dict[str | None, int] = {None: 0}
        self._add_children(None)  # depth first: with any other numbering `crba` is silently wrong
        self.data = self.model.createData()
        self.velocities, self.positions = [], []
        for body in robot.bodies:
            joint = self.model.joints[self.joints[body.name]]
            swap = {6: (3, 4, 5, 0, 1, 2), 3: (0, 1, 2), 1: (0,)}[joint.nv]  # [linear; angular] there
            turn = {7: (0, 1, 2, 6, 3, 4, 5), 4: (3, 0, 1, 2), 1: (0,)}[joint.nq]  # and quaternions (x, y, z, w)
            self.velocities += [joint.idx_v + i for i in swap]
            self.positions += [joint.idx_q + i for i in turn]

    def _add_children(self, parent: str | None) -> None:
        for body in (b for b in self.robot.bodies if b.parent == parent):
            place = self.pin.SE3(np.array(body.placement.rotation), np.array(body.placement.position))
            if body.joint.type == "free":  # its coordinates are its pose in the world
                place = self.pin.SE3.Identity()
            self.joints[body.name] = self.model.addJoint(self.joints[parent], self._joint(body), place, body.name)
            figures = body.inertial.mass, np.array(body.inertial.com), np.array(body.inertial.inertia)
            self.model.appendBodyToJoint(self.joints[body.name], self.pin.Inertia(*figures), self.pin.SE3.Identity())
            self._add_children(body.name)

    def _joint(self, body: Body) -> object:
        if body.joint.type == "free":
            return self.pin.JointModelFreeFlyer()
        if body.joint.type == "ball":
            return self.pin.JointModelSpherical()
        kind = "Revolute" if body.joint.type == "revolute" else "Prismatic"
        return getattr(self.pin, f"JointModel{kind}Unaligned")(np.array(body.joint.axis))

    def _theirs(self, q: Array, *velocities: Array) -> list[Array]:
        configuration = np.zeros(self.model.nq)
        configuration[self.positions] = q
        result = [configuration]
        for v in velocities:
            moved = np.zeros(self.model.nv)
            moved[self.velocities] = v
            result.append(moved)
        return result

    def dynamics(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Mass matrix and bias force of the spanning tree."""
        q, v = self._theirs(q, v)
        M = self.pin.crba(self.model, self.data, q)
        M = np.triu(M) + np.triu(M, 1).T
        h = self.pin.rnea(self.model, self.data, q, v, 0 * v)
        return M[np.ix_(self.velocities, self.velocities)], h[self.velocities]

    def inverse_dynamics(self, q: Array, v: Array, vdot: Array) -> Array:
        """Spanning forces that produce spanning accelerations."""
        return self.pin.rnea(self.model, self.data, *self._theirs(q, v, vdot))[self.velocities]
