"""Named frames: links on fixed joints, sites and welded bodies, and the key `frames` of YAML files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mjcf_files import CHAIN, mjcf
from mujoco_peer import Peer

from ce_gym.dynamics import Model
from ce_gym.model import Frame, Placement, RobotError, check_robot, load_robot

QUARTER = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_links_on_fixed_joints(tmp_path):
    """A chain of two fixed joints, a link on the world, and a rotor's link, which is a body and no frame."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    links = {"world": "", "rail": inertial, "cart": inertial, "mast": "", "tip": inertial, "motor": inertial}
    joints = [
        ("fixed", "world", "rail", '<origin xyz="0 0 1"/>'),
        ("prismatic", "rail", "cart", '<axis xyz="1 0 0"/>'),
        ("fixed", "cart", "mast", '<origin xyz="1 2 3" rpy="0 0 1.5707963267948966"/>'),
        ("fixed", "mast", "tip", '<origin xyz="1 0 0"/>'),
        ("fixed", "cart", "motor", ""),
    ]
    parts = [f'<link name="{name}">{content}</link>' for name, content in links.items()]
    for kind, parent, child, content in joints:
        ends = f'<parent link="{parent}"/><child link="{child}"/>{content}'
        parts.append(f'<joint name="{child}_joint" type="{kind}">{ends}</joint>')
    (tmp_path / "r.urdf").write_text(f'<robot name="r">{"".join(parts)}</robot>')
    welded = (
        Frame("world", None),
        Frame("rail", None, Placement((0.0, 0.0, 1.0))),
        Frame("mast", "cart", Placement((1.0, 2.0, 3.0), QUARTER)),
        Frame("tip", "cart", Placement((1.0, 3.0, 3.0), QUARTER)),
    )
    assert load_robot(tmp_path / "r.urdf").frames == (*welded, Frame("motor", "cart"))
    (tmp_path / "m.yaml").write_text(
        "urdf: r.urdf\nrotors: {motor: {axis: [1, 0, 0], ratios: {cart: 6}}}\n"
        "frames: {eye: {body: tip, xyz: [1, 0, 0]}, base: {body: world}}\n"
    )
    more = Frame("eye", "cart", Placement((1.0, 4.0, 3.0), QUARTER)), Frame("base", None)
    robot = load_robot(tmp_path / "m.yaml")
    assert robot.frames == (*welded, *more)
    assert Model(robot).frame_names == ("cart", "motor", "world", "rail", "mast", "tip", "eye", "base")


def test_sites_and_welded_bodies_of_mjcf(tmp_path):
    """Joints beside the origins of bodies included; a site with the name of a body gains a number."""
    site = '<site name="{}" pos="0.1 0.2 0.3" euler="0.1 0.2 0.3"/>'
    world = CHAIN.replace(
        'name="plate" pos="0 0.1 0" euler="0.3 0 0">', f"{{}}{site.format('plate')}{site.format('s')}"
    )
    world = world.format('name="plate" pos="0 0.1 0" euler="0.3 0 0">') + site.format("far") + "<site/>"
    (tmp_path / "chain.xml").write_text(mjcf(world))
    robot = load_robot(tmp_path / "chain.xml")
    assert {frame.name: frame.body for frame in robot.frames} == {
        "world": None,
        "plate": "wrist",
        "plate_2": "wrist",
        "s": "wrist",
        "far": None,
    }
    model, rng = Model(robot), np.random.default_rng(0)
    peer, q = Peer(tmp_path / "chain.xml", robot, model), rng.uniform(-1, 1, model.nq)
    peer.set_state(q, np.zeros(model.nv))
    places = {name: peer.data.site(name) for name in ("s", "far")} | {"plate": peer.data.body("plate")}
    places["plate_2"] = peer.data.site("plate")
    for name, place in places.items():
        position, rotation = model.frame_pose(q, name)
        np.testing.assert_allclose(position, place.xpos, atol=1e-12)
        np.testing.assert_allclose(rotation, place.xmat.reshape(3, 3), atol=1e-12)


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (Frame("imu", "trunc"), "frames.imu.body is 'trunc': expected the name of a body"),
        (Frame("trunk", "trunk"), "frame name is 'trunk'"),
        (Frame("imu", "trunk", Placement((np.nan, 0.0, 0.0))), "frames.imu position is (nan, 0.0, 0.0)"),
        (Frame("imu", "trunk", Placement(rotation=((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))), "rotation"),
        (Frame("", "trunk"), "frame name is ''"),
    ],
)
def test_wrong_frames(frame: Frame, words: str, write_robot):
    robot = load_robot(write_robot())
    with pytest.raises(RobotError) as error:
        check_robot(replace(robot, frames=(frame,)))
    assert words in str(error.value)


def test_unknown_frames_are_refused():
    model = Model("go1")
    with pytest.raises(ValueError, match=r"frame='FL_foo'; expected a frame of go1: .*\(did you mean 'FL_foot'\?\)"):
        model.frame_pose(model.standing_q, "FL_foo")
    with pytest.raises(KeyError, match="no frame 'FL_foo' for 'frame_pose'"):
        model.casadi_function("frame_pose:FL_foo")
    with pytest.raises(KeyError, match=r"no function 'frame_poses'; expected one of .*'frame_pose:FRAME'"):
        model.casadi_function("frame_poses")
