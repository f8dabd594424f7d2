# pyright: reportAttributeAccessIssue=false
# MuJoCo's compiled modules have no types
"""A tossed cube in ce_gym and in MuJoCo: many candidate parameters times many tosses in one batch."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout

from ce_gym.bench.measured.tosses import INERTIA, MASS, SIDE, Array, Tosses
from ce_gym.compile.system import usable_cores
from ce_gym.dynamics.model import Model
from ce_gym.model import Body, ContactMaterial, ContactSphere, Inertial, Joint, Placement, Pose, Robot
from ce_gym.sim import Simulator

GRAVITY = 9.81
SUBSTEPS = 4
"""Steps between two frames of the measurement: both engines step by 1.7 ms."""
HALF = SIDE / 2
CORNERS = tuple(itertools.product((-1.0, 1.0), repeat=3))
Candidates = Mapping[str, Array]
"""Parameters by name, each of shape (C,)."""
Bounds = dict[str, tuple[float, float]]
COMMON: Bounds = {"friction": (0.1, 0.3), "ground": (-0.004, 0.001)}
"""Bounds of the friction coefficient, and of the height of the table against the measured positions [m]."""


@dataclass(frozen=True)
class Ours:
    """The cube in ce_gym, with a contact sphere at each corner.

    Attributes:
        radius: Radius of the contact spheres [m].
    """

    radius: float

    @property
    def bounds(self) -> Bounds:
        """Bounds of the parameters: those of both engines, stiffness [N/m] and damping [N s/m] of a corner."""
        return COMMON | {"stiffness": (1e3, 1e5), "damping": (5.0, 500.0)}

    def __call__(self, tosses: Tosses, candidates: Candidates) -> Array:
        """Return simulated poses, shape (C, N, T, 7)."""
        q, v, ground = start(tosses, candidates)
        v = np.hstack([v[:, 3:], into_body(q[:, 3:], v[:, :3])])
        names = ("friction", "stiffness", "damping")
        options = {"method": "extrapolated", "num_threads": usable_cores(), "outputs": ()}
        sim = Simulator(Model(cube(self.radius)), len(q), tosses.dt / SUBSTEPS, parameters=names, **options)
        for name in names:
            sim.set_parameter(name, np.repeat(candidates[name], len(tosses.lengths))[:, None])
        sim.set_state(q, v)
        poses = np.empty((len(q), tosses.poses.shape[1], 7))
        poses[:, 0] = q
        for k in range(1, poses.shape[1]):
            sim.step(np.zeros(0), SUBSTEPS)
            poses[:, k] = sim.q
        return above(poses, ground, len(tosses.lengths))


@dataclass(frozen=True)
class Peer:
    """The cube in MuJoCo.

    Attributes:
        radius: Radius of a sphere at each corner [m]; None for a box.
        cone: "elliptic" or "pyramidal".
        impedance: Whether to fit the impedance, too.
    """

    radius: float | None
    cone: str = "elliptic"
    impedance: bool = False

    @property
    def bounds(self) -> Bounds:
        """Bounds of the parameters: those of both engines, `solref` and, on request, `solimp`."""
        more = {"d0": (0.1, 0.99), "dmax": (0.5, 0.999), "width": (1e-4, 1e-2)} if self.impedance else {}
        return COMMON | {"timeconst": (2.0 * 0.00169, 0.05), "dampratio": (0.2, 5.0)} | more

    def __call__(self, tosses: Tosses, candidates: Candidates) -> Array:
        """Return simulated poses, shape (C, N, T, 7)."""
        q, v, ground = start(tosses, candidates)
        dt, n, rows = tosses.dt / SUBSTEPS, len(tosses.lengths), range(len(candidates["ground"]))
        models = [self._model(dt, {name: values[i] for name, values in candidates.items()}) for i in rows]
        datas = [mujoco.MjData(models[0]) for _ in range(usable_cores())]
        states = np.hstack([np.zeros((len(q), 1)), q, v])
        steps = SUBSTEPS * (tosses.poses.shape[1] - 1)
        repeated = [model for model in models for _ in range(n)]
        after = np.asarray(rollout.rollout(repeated, datas, states, nstep=steps)[0])
        poses = np.concatenate([q[:, None], after[:, SUBSTEPS - 1 :: SUBSTEPS, 1:8]], axis=1)
        return above(poses, ground, n)

    def _model(self, dt: float, p: Mapping[str, float]) -> mujoco.MjModel:
        d0, width = p.get("d0", 0.9), p.get("width", 0.001)
        material = (
            f'friction="{p["friction"]} 0 0" solref="{p["timeconst"]} {p["dampratio"]}" '
            f'solimp="{d0} {max(d0, p.get("dmax", 0.95))} {width}"'
        )
        centre = HALF - (self.radius or 0.0)
        shapes = [f'<geom type="box" size="{HALF} {HALF} {HALF}" {material}/>']
        if self.radius is not None:
            places = [" ".join(str(centre * sign) for sign in signs) for signs in CORNERS]
            shapes = [f'<geom size="{self.radius}" pos="{place}" {material}/>' for place in places]
        return mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{dt}" cone="{self.cone}" integrator="implicitfast" gravity="0 0 {-GRAVITY}"/>'
            f'<worldbody><geom type="plane" size="0 0 1" {material}/><body><freejoint/>'
            f'<inertial pos="0 0 0" mass="{MASS}" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>'
            f"{''.join(shapes)}</body></worldbody></mujoco>"
        )


def cube(radius: float) -> Robot:
    """Return the cube with contact spheres that touch the faces from inside at the corners."""
    inertia = ((INERTIA, 0.0, 0.0), (0.0, INERTIA, 0.0), (0.0, 0.0, INERTIA))
    body = Body("cube", "link", None, Placement(), Joint("free"), Inertial(MASS, (0.0, 0.0, 0.0), inertia))
    centre = HALF - radius
    contacts = tuple(
        ContactSphere(f"corner{i}", "cube", (centre * x, centre * y, centre * z), radius)
        for i, (x, y, z) in enumerate(CORNERS)
    )
    return Robot("cube", (body,), contacts=contacts, material=ContactMaterial(), pose=Pose(HALF))


def start(tosses: Tosses, candidates: Candidates) -> tuple[Array, Array, Array]:
    """Return first poses above the candidates' tables, velocities and heights of the tables, all of C * N rows."""
    count, n = len(candidates["ground"]), len(tosses.lengths)
    ground = np.repeat(candidates["ground"], n)
    q = np.tile(tosses.poses[:, 0], (count, 1))
    q[:, 2] -= ground
    return q, np.tile(tosses.velocities, (count, 1)), ground


def above(poses: Array, ground: Array, n: int) -> Array:
    """Return poses above the table (C * N, T, 7) in the frame of the measurement, shape (C, N, T, 7)."""
    poses[..., 2] += ground[:, None]
    return poses.reshape(-1, n, *poses.shape[1:])


def into_body(quaternions: Array, vectors: Array) -> Array:
    """Rotate vectors (..., 3) from world axes into the axes of bodies with quaternions (..., 4)."""
    w, xyz = quaternions[..., :1], -quaternions[..., 1:]
    twice = 2.0 * np.cross(xyz, vectors)
    return vectors + w * twice + np.cross(xyz, twice)
