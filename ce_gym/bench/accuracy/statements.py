# pyright: reportAttributeAccessIssue=false
"""Elements of scenes that the MJCF export lacks, added for MuJoCo: transmission springs, stairs, capsules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import TypeAlias

import mujoco
import numpy as np

from ce_gym.bench.accuracy.scenarios import Scene
from ce_gym.export.joint_ties import joint_ties
from ce_gym.model import Robot
from ce_gym.model.checks.collisions import capsules_of
from ce_gym.model.mechanism import ELASTIC, build_mechanism

Stating: TypeAlias = Callable[[Scene, mujoco.MjSpec], None]
"""Function that adds elements of a scene to a MuJoCo specification."""


def stated(scene: Scene, level: str) -> tuple[Robot, str, Callable[[mujoco.MjSpec], None]]:
    """Return robot and level of the export, and a function that completes the MuJoCo specification."""

    def also(spec: mujoco.MjSpec) -> None:
        for say in said:
            say(scene, spec)

    said: list[Stating] = [boxes] if scene.terrain is not None else []
    if scene.touching:
        said.append(capsules)
    if level != ELASTIC:
        return scene.robot, level, also
    rotors = tuple(elastic.rotor for elastic in scene.robot.elastic)
    ties = tuple(tie for tie in scene.robot.constraints if not set(rotors) & set(tie.bodies))
    free = replace(scene.robot, constraints=ties, independent=(*scene.robot.independent, *rotors), elastic=())
    said.append(tendons)
    return free, "exact", also


def ratios(robot: Robot) -> dict[str, dict[str, float]]:
    """Return the ratio of each rotor to each independent joint, by rotor and joint."""
    ties = joint_ties(build_mechanism(robot, "exact", eliminate=False))
    return {rotor.name: ties[rotor.name].ratios for rotor in robot.rotors()}


def tendons(scene: Scene, spec: mujoco.MjSpec) -> None:
    """Add tendons between rotors and joints, whose length is the stretch, with stiffness and damping."""
    of, joint_name = ratios(scene.robot), scene.robot.joint_name
    for elastic in scene.robot.elastic:
        tendon = spec.add_tendon(name=f"{elastic.rotor}_spring", springlength=[0.0, 0.0])
        tendon.stiffness[0], tendon.damping[0] = elastic.stiffness, elastic.damping
        tendon.wrap_joint(joint_name(elastic.rotor), 1.0)
        for joint, ratio in of[elastic.rotor].items():
            tendon.wrap_joint(joint_name(joint), -ratio)


def capsules(scene: Scene, spec: mujoco.MjSpec) -> None:
    """Add capsules of links with contact between each other, without friction; each pair has its own bit."""
    for i, pair in enumerate(scene.touching):
        for link, bits in zip(pair, ({"contype": 2 << i}, {"conaffinity": 2 << i}), strict=True):
            for capsule in capsules_of(scene.robot, link):
                masks = {"contype": 0, "conaffinity": 0, **bits}
                spec.body(link).add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                    fromto=[*capsule.start, *capsule.end],
                    size=[capsule.radius, 0.0, 0.0],
                    condim=1,
                    **masks,
                )


HALF_WIDTH, DEEP = 3.0, 1.0
"""Half width and depth of stairs in MuJoCo [m]."""


def boxes(scene: Scene, spec: mujoco.MjSpec) -> None:
    """Add a box for every step of stairs; edges are sharp, but MuJoCo's height field is slower."""
    terrain = scene.terrain
    assert terrain is not None  # called only for scenes with a height field
    heights = terrain.heights[:, 0]
    x = terrain.origin[0] + terrain.cell * np.arange(len(heights))
    edges = [*np.flatnonzero(np.diff(heights)), len(heights) - 1]
    for first, last in pairwise(edges):
        start, end = (x[i] + terrain.cell / 2 for i in (first, last))
        half = [(end - start) / 2 + (HALF_WIDTH if last == edges[-1] else 0.0), HALF_WIDTH, DEEP / 2]
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[start + half[0], 0.0, heights[last] - DEEP / 2],
            size=half,
            friction=[scene.robot.material.friction, 0.005, 0.0001],
            contype=0,  # only contact spheres touch the ground
            conaffinity=1,
        )
