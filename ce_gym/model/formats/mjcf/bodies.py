"""The bodies of a compiled MJCF file -> a tree of bodies with one joint each.

MuJoCo's body without joint is welded to its parent. If it has several joints, all but the last move massless links. A
joint may turn about a point other than the body's origin, and `ref` is the coordinate of the pose in the file. Here, a
body turns about its own origin and its coordinate is MuJoCo's `qpos`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ce_gym.model.description import Body, Inertial, Joint, Shape
from ce_gym.model.errors import invalid_value
from ce_gym.model.formats.hinges import coincident_hinges
from ce_gym.model.formats.mjcf.scenes import robot_hint
from ce_gym.model.formats.mjcf.source import MjcfSource, placement, rotation
from ce_gym.model.formats.placement import compose, mat3, merge_inertials, transform_inertial, vec3
from ce_gym.model.formats.rotor_links import FixedLink
from ce_gym.model.frames import ZERO, Placement, Vec3

_UNLIMITED = (-float("inf"), float("inf"))


@dataclass
class MjcfTree:
    """The bodies of a file, and the places of MuJoCo's bodies and joints among them.

    Attributes:
        bodies: Parents before children, a free base first.
        frames: For each of MuJoCo's bodies, the body (None: the world) that carries its frame, and the pose in it.
        moved_by: The body that each of MuJoCo's joints moves, by joint index, without locked joints and ball joints
            that became hinges.
        hinged: The bodies of the three hinges of each ball joint that became hinges, by joint index.
        fixed: Separate bodies without a joint, by name.
        ties: Names of constraints.
    """

    bodies: list[Body] = field(default_factory=list)
    frames: list[tuple[str | None, Placement]] = field(default_factory=lambda: [(None, Placement())])
    moved_by: dict[int, str] = field(default_factory=dict)
    hinged: dict[int, tuple[Body, Body, Body]] = field(default_factory=dict)
    fixed: dict[str, FixedLink] = field(default_factory=dict)
    ties: set[str] = field(default_factory=set)

    def fresh(self, name: str) -> str:
        """Return `name`, or `name_2` and so on if a body or a constraint has this name already."""
        return _fresh(name, {body.name for body in self.bodies} | self.ties)

    def fresh_tie(self, name: str) -> str:
        """Return a new name for a constraint, and reserve it."""
        self.ties.add(new := _fresh(name, self.ties))
        return new

    def parent(self, body: str) -> str | None:
        """Return the parent of a body."""
        return next(b.parent for b in self.bodies if b.name == body)


def _fresh(name: str, taken: Collection[str]) -> str:
    count, new = 1, name
    while new in taken:
        count += 1
        new = f"{name}_{count}"
    return new


def read_bodies(
    source: MjcfSource, locked: Mapping[int, float], hinged: Mapping[int, Vec3], apart: Collection[str] = ()
) -> MjcfTree:
    """Read the tree of bodies.

    Args:
        source: The compiled file.
        locked: Coordinates [rad or m] of joints that an equality fixes, by joint index; they become welds.
        hinged: Axes of spin of ball joints that become hinges, by joint index.
        apart: Names of bodies without joint to keep separate; other names have no effect.

    Raises:
        RobotError: Nothing moves, or several bodies move freely.
    """
    tree, model = MjcfTree(), source.model
    for index in range(1, model.nbody):
        _add_body(source, tree, index, locked, hinged, apart)
    if not tree.bodies:
        hint = robot_hint(Path(source.file))
        raise invalid_value(source.file, "bodies that move", (), f"at least one body with a joint{hint}")
    _report_forces(source)
    tree.bodies.sort(key=lambda body: body.joint.type != "free")
    free = [body.name for body in tree.bodies if body.joint.type == "free"]
    if len(free) > 1:
        raise invalid_value(
            source.file,
            "bodies that move freely",
            tuple(free),
            "one robot, so at most one free joint",
        )
    return tree


def _add_body(
    source: MjcfSource,
    tree: MjcfTree,
    index: int,
    locked: Mapping[int, float],
    hinged: Mapping[int, Vec3],
    apart: Collection[str],
) -> None:
    model = source.model
    name = source.name("body", index)
    carrier, pose = tree.frames[model.body_parentid[index]]
    frame = compose(pose, placement(model.body_pos[index], model.body_quat[index]))
    first = model.body_jntadr[index]
    joints = list(range(first, first + model.body_jntnum[index]))
    moving = [j for j in joints if j not in locked]
    for j in joints:
        if j in locked:
            frame = compose(frame, _motion(source, j, locked[j]))
            continue
        link = tree.fresh(name if j == moving[-1] else source.name("joint", j))
        moved = _moved_body(source, j, link, carrier, frame)
        if j in hinged:
            tree.hinged[j] = coincident_hinges(_at_reference(source, j, moved), hinged[j])
            tree.bodies += tree.hinged[j]
        else:
            tree.bodies.append(moved)
            tree.moved_by[j] = link
        carrier, frame = link, _after(source, j)
    tree.frames.append((carrier, frame))
    if name in apart and not joints:
        tree.fixed[name] = FixedLink(carrier, frame, _inertial(source, index))
    elif carrier is not None and model.body_mass[index] > 0.0:
        _join(source, tree, carrier, index, bool(moving))


def _inertial(source: MjcfSource, index: int) -> Inertial:
    """Return the mass properties of one of MuJoCo's bodies in its own frame."""
    model = source.model
    axes = rotation(model.body_iquat[index])
    inertia = axes @ np.diag(model.body_inertia[index]) @ axes.T
    return Inertial(float(model.body_mass[index]), vec3(model.body_ipos[index]), mat3((inertia + inertia.T) / 2))


def _join(source: MjcfSource, tree: MjcfTree, carrier: str, index: int, has_joint: bool) -> None:
    """Give a body's mass and shapes to the link that carries it."""
    part = transform_inertial(tree.frames[index][1], _inertial(source, index))
    at = next(i for i, body in enumerate(tree.bodies) if body.name == carrier)
    body = tree.bodies[at]
    tree.bodies[at] = replace(body, inertial=part if has_joint else merge_inertials([body.inertial, part]))


def _moved_body(source: MjcfSource, j: int, name: str, carrier: str | None, frame: Placement) -> Body:
    """Return the body that joint `j` moves, without mass; `frame` is where MuJoCo's body is at `qpos = ref`."""
    model, kinds = source.model, source.mujoco.mjtJoint
    kind = model.jnt_type[j]
    nothing = Inertial(0.0, ZERO, (ZERO, ZERO, ZERO))
    if kind == kinds.mjJNT_FREE:
        return Body(name, "link", None, Placement(), Joint("free"), nothing)
    dof = model.jnt_dofadr[j]
    damping = float(model.dof_damping[dof])
    if kind == kinds.mjJNT_BALL:
        furthest = float(model.jnt_range[j][1]) if model.jnt_limited[j] else np.inf
        pivot = compose(frame, Placement(_pivot(source, j)))
        ball = Joint("ball", position=(-np.inf, furthest), damping=damping, stiffness=float(model.jnt_stiffness[j]))
        ball = replace(ball, name=source.given_name("joint", j))
        return Body(name, "link", carrier, pivot, ball, nothing)
    limits = model.jnt_range[j] if model.jnt_limited[j] else _UNLIMITED
    joint = Joint(
        type="revolute" if kind == kinds.mjJNT_HINGE else "prismatic",
        axis=_axis(source, j),
        position=(float(limits[0]), float(limits[1])),
        damping=damping,
        friction=float(model.dof_frictionloss[dof]),
        stiffness=float(model.jnt_stiffness[j]),
        springref=float(model.qpos_spring[model.jnt_qposadr[j]]) if model.jnt_stiffness[j] else 0.0,
        name=source.given_name("joint", j),
    )
    at_zero = compose(frame, _motion(source, j, 0.0))
    pivot = compose(at_zero, Placement(_pivot(source, j)))
    return Body(name, "link", carrier, pivot, joint, nothing)


def _at_reference(source: MjcfSource, j: int, body: Body) -> Body:
    """Return the body of a ball joint that becomes hinges, in its reference orientation, the zero of the hinges."""
    model = source.model
    if model.jnt_limited[j]:
        source.leave_out("limit of ball joint {}, which is part of a loop", source.name("joint", j))
    if model.jnt_stiffness[j]:
        source.leave_out("spring of ball joint {}, which is part of a loop", source.name("joint", j))
    address = model.jnt_qposadr[j]
    turned = placement(np.zeros(3), source.data.qpos[address : address + 4])
    return replace(body, placement=compose(body.placement, turned))


def _after(source: MjcfSource, j: int) -> Placement:
    """Pose of MuJoCo's body in the frame of the body that its joint `j` moves."""
    return Placement(vec3([-x + 0.0 for x in _pivot(source, j)]))


def _pivot(source: MjcfSource, j: int) -> Vec3:
    """The point of MuJoCo's body that is the origin of ours [m]: where a hinge's axis passes, the centre of a ball."""
    kinds = source.mujoco.mjtJoint
    turns = int(source.model.jnt_type[j]) in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_BALL))
    return vec3(source.model.jnt_pos[j]) if turns else ZERO


def _axis(source: MjcfSource, j: int) -> Vec3:
    axis = source.model.jnt_axis[j]
    return vec3(axis / np.linalg.norm(axis) + 0.0)


def _motion(source: MjcfSource, j: int, coordinate: float) -> Placement:
    """Pose, in the frame that MuJoCo's body has at `qpos = ref`, of the same frame at `qpos = coordinate`."""
    model = source.model
    axis = np.array(_axis(source, j))
    travel = coordinate - float(model.qpos0[model.jnt_qposadr[j]])
    if model.jnt_type[j] != source.mujoco.mjtJoint.mjJNT_HINGE:
        return Placement(vec3(travel * axis))
    turn = placement(np.zeros(3), np.array([np.cos(travel / 2), *(np.sin(travel / 2) * axis)]))
    pivot = _pivot(source, j)
    moved_pivot = compose(Placement(pivot), turn)
    return compose(moved_pivot, _after(source, j))


def _report_forces(source: MjcfSource) -> None:
    """Note passive forces of joints and bodies without counterpart in a robot."""
    model, kinds = source.model, source.mujoco.mjtJoint
    bent = np.atleast_1d(getattr(model, "dof_dampingpoly", np.zeros(model.nv)))
    for j in range(model.njnt):
        dof, count = model.jnt_dofadr[j], {int(kinds.mjJNT_FREE): 6, int(kinds.mjJNT_BALL): 3}
        dofs = slice(dof, dof + count.get(int(model.jnt_type[j]), 1))
        if dofs.stop > dof + 1 and np.any(model.dof_frictionloss[dofs]):
            source.leave_out("dry friction of joint {}", source.name("joint", j))
        if np.any(bent[dofs]):
            source.leave_out("nonlinear damping of joint {}", source.name("joint", j))
        if model.jnt_stiffness[j] and model.jnt_type[j] == source.mujoco.mjtJoint.mjJNT_FREE:
            source.leave_out("spring of joint {}", source.name("joint", j))
        if np.any(getattr(model, "jnt_stiffnesspoly", np.zeros((model.njnt, 1)))[j]):
            source.leave_out("nonlinear part of the spring of joint {}", source.name("joint", j))
    for i in range(1, model.nbody):
        if model.body_gravcomp[i]:
            source.leave_out("gravity compensation of body {}", source.name("body", i))
        if model.body_mocapid[i] >= 0:
            source.leave_out("motion capture of body {}", source.name("body", i))


def read_sites(source: MjcfSource, tree: MjcfTree) -> dict[str, tuple[str | None, Placement]]:
    """Return body and pose of each site with a name; a site with the name of a body gains a number."""
    model = source.model
    taken = {source.name("body", i) for i in range(model.nbody)} | {body.name for body in tree.bodies}
    sites: dict[str, tuple[str | None, Placement]] = {}
    for i in range(model.nsite):
        if name := source.given_name("site", i):
            body, frame = tree.frames[model.site_bodyid[i]]
            pose = compose(frame, placement(model.site_pos[i], model.site_quat[i]))
            sites[_fresh(name, taken | sites.keys())] = body, pose
    return sites


def shapes(source: MjcfSource, tree: MjcfTree) -> Iterator[tuple[str, Shape]]:
    """Iterate over primitives to draw, each with the body that carries it."""
    model, kinds = source.model, source.mujoco.mjtGeom
    types = {kinds.mjGEOM_BOX: "box", kinds.mjGEOM_SPHERE: "sphere"}
    types |= {kinds.mjGEOM_CAPSULE: "capsule", kinds.mjGEOM_CYLINDER: "cylinder"}
    undrawn = 0
    for geom in range(model.ngeom):
        carrier, frame = tree.frames[model.geom_bodyid[geom]]
        kind = types.get(kinds(int(model.geom_type[geom])))
        if carrier is None:
            continue
        if kind is None:  # meshes are drawn by the viewer, which reads the file again
            undrawn += kinds(int(model.geom_type[geom])) != kinds.mjGEOM_MESH
            continue
        a, b, c = (float(x) for x in model.geom_size[geom])
        size = {"box": (2 * a, 2 * b, 2 * c), "sphere": (a,)}.get(kind, (a, 2 * b))
        pose = compose(frame, placement(model.geom_pos[geom], model.geom_quat[geom]))
        red, green, blue, alpha = (float(x) for x in model.geom_rgba[geom])
        yield carrier, Shape(kind, size, pose, (red, green, blue, alpha))  # type: ignore[arg-type]
    if undrawn:
        source.leave_out("the drawing of {} geoms (ellipsoids and the like)", str(undrawn))
