"""The scene's commands, replayed by a small interpreter, put every body at the model's pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hopper import StandIn, make_robot, make_rollout
from hypothesis import given
from hypothesis import strategies as st

from ce_gym import Terrain
from ce_gym.model.description import ContactSphere
from ce_gym.viewer import Rollout, ViewerError
from ce_gym.viewer.page import three
from ce_gym.viewer.page.arrows import HIDDEN
from ce_gym.viewer.page.fallback_shapes import frame_along
from ce_gym.viewer.page.scene import ROOT, places, pose_rollouts
from ce_gym.viewer.page.scene import build_scene as build_scene_of_runs
from ce_gym.viewer.rollouts.ground_patch import around


def build_scene(rollouts: list, models: list, max_fps: float = 50.0, **options: float | None) -> list[dict]:
    return build_scene_of_runs(pose_rollouts(rollouts, models, max_fps), **options)


def clips_of(commands: list[dict]) -> dict[str, dict[str, np.ndarray]]:
    """Values of every animated path by track name, two rows where a track is constant."""
    assert commands[-1]["type"] == "set_animation"
    result = {}
    for moved in commands[-1]["animations"]:
        items = moved["clip"]["tracks"]
        result[moved["path"]] = {t["name"][1:]: np.reshape(t["values"], (len(t["times"]), -1)) for t in items}
    return result


def matrix_at(clip: dict[str, np.ndarray], frame: int) -> np.ndarray:
    def value(name: str, default: list[float]) -> np.ndarray:
        return clip[name][min(frame, len(clip[name]) - 1)] if name in clip else np.array(default)

    x, y, z, w = value("quaternion", [0, 0, 0, 1])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return three.transform(value("position", [0, 0, 0]), rotation * value("scale", [1, 1, 1]))


def world(clips: dict, path: str, frame: int) -> np.ndarray:
    """Pose of a path, the world's own shift left out."""
    parts = path.strip("/").split("/")
    result = np.eye(4)
    for count in range(2, len(parts) + 1):
        result = result @ matrix_at(clips.get("/" + "/".join(parts[:count]), {}), frame)
    return result


@pytest.fixture
def scene() -> list[dict]:
    return build_scene([make_rollout()], [StandIn(make_robot())])


def test_bodies_are_where_the_model_says(scene: list[dict]) -> None:
    clips, rollout, model = clips_of(scene), make_rollout(), StandIn(make_robot())
    positions, rotations = model.body_poses(rollout.q)
    for index, path in enumerate(["base", "base/leg_1", "base/rotor"]):
        for frame in (0, 7, 31, 49):
            pose = world(clips, f"{ROOT}/0/{path}", frame)
            np.testing.assert_allclose(pose[:3, 3], positions[frame, index], atol=1e-9)
            np.testing.assert_allclose(pose[:3, :3], rotations[frame, index], atol=1e-9)


def test_force_arrow_starts_at_the_contact_and_points_along_the_force(scene: list[dict]) -> None:
    clips, rollout, model = clips_of(scene), make_rollout(), StandIn(make_robot())
    positions, rotations = model.body_poses(rollout.q)
    frame = 12
    pose = world(clips, f"{ROOT}/0/contact forces/foot", frame)
    contact = positions[frame, 1] + rotations[frame, 1] @ [0, 0, -0.25] - [0, 0, 0.02]
    np.testing.assert_allclose(pose[:3, 3], contact, atol=1e-9)
    tip = pose[:3, 2]
    assert tip[2] > 0.05
    np.testing.assert_allclose(tip[:2], 0, atol=1e-9)
    # No arrow is seen in the first frame, whose force is zero.
    np.testing.assert_allclose(clips[f"{ROOT}/0/contact forces/foot"]["scale"][0], HIDDEN)


def test_forces_of_some_contacts_go_to_those(scene: list[dict]) -> None:
    robot = make_robot()
    two = replace(robot, contacts=(ContactSphere("knee", "base", (0, 0, 0), 0.1), *robot.contacts))
    commands = build_scene([make_rollout(contact_names=["foot"])], [StandIn(two)])
    path = f"{ROOT}/0/contact forces/foot"
    np.testing.assert_allclose(world(clips_of(commands), path, 5)[:3, 3], world(clips_of(scene), path, 5)[:3, 3])


def test_command_arrow_turns_with_the_robot(scene: list[dict]) -> None:
    clips, rollout = clips_of(scene), make_rollout()
    yaw = rollout.q[20, 3]
    expected = [0.5 * np.cos(yaw) - 0.1 * np.sin(yaw), 0.5 * np.sin(yaw) + 0.1 * np.cos(yaw)]
    tip = world(clips, f"{ROOT}/0/command", 20)[:2, 2]
    np.testing.assert_allclose(tip / np.linalg.norm(tip), expected / np.linalg.norm(expected), atol=1e-9)
    speed = world(clips, f"{ROOT}/0/velocity", 20)[:2, 2]
    np.testing.assert_allclose(speed[1] / speed[0], 0.1 / 0.5, rtol=1e-9)


def test_the_world_moves_against_the_robot(scene: list[dict]) -> None:
    shift, rollout = clips_of(scene)[ROOT]["position"], make_rollout()
    np.testing.assert_allclose(shift[:, :2], -rollout.q[:, :2], atol=1e-9)  # it walks straight ahead
    assert (shift[:, 2] == shift[0, 2]).all()
    assert shift[0, 2] < 0  # the camera looks at the origin, and is to see the middle of the robot


def test_a_robot_with_a_fixed_base_is_in_the_middle_of_the_picture() -> None:
    from ce_gym.dynamics import Model

    model = Model("four_bar")
    q = np.tile(model.standing_q, (3, 1))
    rollout = Rollout("four_bar", "exact", 0.02, 0.02 * np.arange(3), q, np.zeros((3, 1)))
    shift = clips_of(build_scene([rollout], [model]))[ROOT]["position"]
    np.testing.assert_allclose(shift[:, :2], [[-0.5, -0.25]] * len(shift), atol=0.02)  # a bar 1 m long, arms 0.5 m long


def test_clips_end_together_and_high_rates_are_thinned() -> None:
    model = StandIn(make_robot())
    commands = build_scene([make_rollout(50), make_rollout(20)], [model] * 2)
    (end,) = {float(t["times"][-1]) for animation in commands[-1]["animations"] for t in animation["clip"]["tracks"]}
    assert end == pytest.approx(0.98)
    commands = build_scene([make_rollout(1000, step=0.001)], [model], max_fps=50)
    assert len(clips_of(commands)[f"{ROOT}/0/base"]["quaternion"]) == pytest.approx(50, abs=1)
    commands = build_scene([make_rollout(1)], [model])
    assert commands[-1]["animations"][0]["clip"]["tracks"][0]["times"].tolist() == [0.0, 0.02]


def test_neighbours_keep_apart_and_ghosts_do_not() -> None:
    models, rollouts = [StandIn(make_robot())] * 2, [make_rollout()] * 2

    def lateral(spacing: float | None) -> list[float]:
        commands = build_scene(rollouts, models, spacing=spacing)
        moved = [c for c in commands if c["type"] == "set_transform" and c["path"].startswith(f"{ROOT}/")]
        return [c["matrix"][13] for c in moved]

    left, right = lateral(None)
    assert left - right > 0.4
    assert lateral(0.0) == [0.0, 0.0]
    ghosts = [c for c in build_scene(rollouts, models, spacing=0.0) if c["path"].startswith(f"{ROOT}/1/base/link")]
    assert ghosts[0]["object"]["materials"][0]["transparent"]


def test_many_stand_in_a_square_and_start_towards_the_same_side() -> None:
    turned = make_rollout()
    turned.q[:, 3] += 1.0
    turned.q[:, :2] += [3.0, 4.0]
    rollouts = [make_rollout(), turned] * 4 + [make_rollout()]
    runs = pose_rollouts(rollouts, [StandIn(make_robot())] * 9)
    poses = [pose @ run.start for pose, run in zip(places(runs, 2.0), runs, strict=True)]
    expected = [[x, y, 0.0] for x in (2.0, 0.0, -2.0) for y in (2.0, 0.0, -2.0)]
    np.testing.assert_allclose([pose[:3, 3] for pose in poses], expected, atol=1e-12)
    np.testing.assert_allclose([pose[:3, :3] for pose in poses], [np.eye(3)] * 9, atol=1e-12)


def fields_of(commands: list[dict]) -> dict[str, dict]:
    found = {c["path"]: c["object"]["object"].get("userData", {}) for c in commands if c["type"] == "set_object"}
    return {path: data["field"] for path, data in found.items() if "field" in data}


def on(terrain: Terrain, **changes: object) -> Rollout:
    """The rollout, raised to the ground under it."""
    rollout = make_rollout(**changes)
    rollout.q[:, 2] += terrain.at(rollout.q[:, 0], rollout.q[:, 1])[:, 0]
    return replace(rollout, ground=around(terrain, rollout.q[:, :2]))


def test_ground_that_is_not_flat_takes_the_place_of_the_plane(scene: list[dict]) -> None:
    assert fields_of(scene) == {}
    assert f"{ROOT}/ground" in objects(scene, ROOT)
    model = StandIn(make_robot())
    slope = Terrain.slope(0.3, heading=1.0)
    commands = build_scene([on(slope)], [model])
    (path, field), *others = fields_of(commands).items()
    assert (path, others) == (f"{ROOT}/ground", [])
    assert field["bodies"] == [f"{ROOT}/0/base"]
    assert 8.0 <= field["reach"] <= 9.0  # to a cell, 1 m here
    # The robot stands as before, and the ground is put where the robot's world is.
    placed = {c["path"]: c["matrix"] for c in commands if c["type"] == "set_transform"}
    assert placed[path] == placed[f"{ROOT}/0"]
    first = world(clips_of(commands), f"{ROOT}/0/base", 0)
    np.testing.assert_allclose(first[:3, 3], on(slope).q[0, :3], atol=1e-9)


def test_the_camera_climbs_with_the_robot(scene: list[dict]) -> None:
    slope = Terrain.slope(0.3)
    shift = clips_of(build_scene([on(slope)], [StandIn(make_robot())]))[ROOT]["position"]
    flat = clips_of(scene)[ROOT]["position"]
    np.testing.assert_allclose(shift[:, :2], flat[:, :2], atol=1e-9)
    climbed = np.tan(0.3) * (make_rollout().q[:, 0] - make_rollout().q[0, 0])
    np.testing.assert_allclose(shift[:, 2], flat[0, 2] - climbed, atol=1e-9)


def test_ghosts_share_ground_and_neighbours_have_their_own() -> None:
    models, terrain = [StandIn(make_robot())] * 2, Terrain.rough(seed=0, amplitude=0.02, size=30.0)
    rollouts = [on(terrain), on(terrain, q=make_rollout().q + [0.1, 0.2, 0, 0, 0, 0])]
    (field,) = fields_of(build_scene(rollouts, models, spacing=0.0)).values()
    assert field["bodies"] == [f"{ROOT}/0/base", f"{ROOT}/1/base"]
    apart = fields_of(build_scene(rollouts, models))
    assert [field["bodies"] for field in apart.values()] == [[f"{ROOT}/0/base"], [f"{ROOT}/1/base"]]
    runs = pose_rollouts(rollouts, models)
    assert all(field["reach"] == pytest.approx(1.5 * runs[0].extent.radius) for field in apart.values())  # no two meet
    mixed = fields_of(build_scene([rollouts[0], make_rollout()], models))
    flat = mixed[f"{ROOT}/ground_1"]
    assert (flat["low"], flat["step"]) == (0.0, 0.0)


def objects(commands: list[dict], under: str) -> dict[str, str]:
    found = [c for c in commands if c["type"] == "set_object" and c["path"].startswith(under)]
    found = [c for c in found if "overlay_" not in c["path"]]
    return {c["path"]: c["object"]["geometries"][0]["type"] for c in found}


def test_every_kind_of_shape_is_drawn_or_a_stick_figure(scene: list[dict]) -> None:
    assert objects(scene, f"{ROOT}/0/base") == {
        f"{ROOT}/0/base/link_0": "BoxGeometry",
        f"{ROOT}/0/base/leg_1/link_0": "LatheGeometry",
        f"{ROOT}/0/base/leg_1/link_1": "SphereGeometry",
        f"{ROOT}/0/base/rotor/rotor_0": "CylinderGeometry",
        f"{ROOT}/0/base/rotor/rotor_0_spoke": "BoxGeometry",
    }
    commands = build_scene([make_rollout()], [StandIn(make_robot(shapes=False))])
    kinds = list(objects(commands, f"{ROOT}/0/base").values())
    assert kinds.count("SphereGeometry") == 4  # three bodies and a contact
    assert kinds.count("CylinderGeometry") == 3  # to two children and the contact
    points = three.capsule(0.1, 0.4)["points"]
    assert max(p["y"] for p in points) == pytest.approx(0.3)
    assert max(p["x"] for p in points) == pytest.approx(0.1, rel=1e-2)


def test_a_rotor_without_shapes_is_hidden() -> None:
    robot = make_robot(rotor_shape=False)
    commands = build_scene([make_rollout()], [StandIn(robot)])
    hidden = [c for c in commands if c["type"] == "set_property" and c["path"] == f"{ROOT}/0/base/rotor/inside"]
    assert [(c["property"], c["value"]) for c in hidden] == [("visible", False)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"q": np.zeros((50, 3))}, "does not fit the robot: q has 3 columns"),
        ({"contact_forces": np.zeros((50, 2, 3))}, "forces of 2 contacts; the robot has 1"),
        ({"contact_names": ["hand"]}, "contact 'hand', which the robot lacks"),
        (None, "nothing to show"),
    ],
)
def test_rollouts_that_do_not_fit_are_refused(changes: dict | None, message: str) -> None:
    rollouts = [] if changes is None else [make_rollout(**changes)]
    with pytest.raises(ViewerError, match=message):
        build_scene(rollouts, [StandIn(make_robot())][: len(rollouts)])


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quaternions_invert_rotations(q: list[float]) -> None:
    unit = np.array(q) / np.linalg.norm(q)
    rotation = matrix_at({"quaternion": unit[None]}, 0)[:3, :3]
    assert abs(three.quaternions(rotation) @ unit) == pytest.approx(1, abs=1e-12)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_frames_are_right_handed_and_point_where_they_should(direction: list[float]) -> None:
    frame = frame_along(np.array(direction))
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)
    assert frame[:, 2] @ direction == pytest.approx(np.linalg.norm(direction), abs=1e-9)
