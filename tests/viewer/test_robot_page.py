"""The page of a robot file: sliders move independent joints, dependent joints follow the constraints."""

from __future__ import annotations

import json
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from ball_joints import with_balls
from chromium import PROGRAM, Chromium

from ce_gym.__main__ import main
from ce_gym.dynamics import Model
from ce_gym.model import RobotError, load_robot
from ce_gym.viewer.preparing import Preparing
from ce_gym.viewer.robot_page import RobotPage
from ce_gym.viewer.stream import LivePage, serving

pytest.importorskip("meshcat")

PUP = Path(__file__).parents[1] / "data" / "own_robot" / "pup.urdf"
WHEEL = """<robot name="cart"><link name="box"><inertial><mass value="2"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
<joint name="axle" type="continuous"><parent link="box"/><child link="wheel"/><axis xyz="0 1 0"/></joint>
<link name="wheel"><inertial><mass value="1"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>
<visual><geometry><sphere radius="0.1"/></geometry></visual></link></robot>"""


def ask(page: RobotPage, values: list[float]) -> dict:
    """Move the sliders, and return the state that the page receives."""
    page.receive(json.dumps({"do": "move", "values": values}).encode())
    page.update()
    return page.state()


@pytest.mark.parametrize("name", ["cassie", "tello", "g1"])
def test_dependent_joints_meet_the_constraints(name: str) -> None:
    page = RobotPage(load_robot(name))
    model, robot = page.model, page.model.robot
    assert page.q(page.standing) == pytest.approx(model.standing_q, abs=1e-12)
    low, high = np.array([(slider["low"], slider["high"]) for slider in page.sliders]).T
    values = page.standing + 0.1 * (0.5 * (low + high) - page.standing)
    state = ask(page, values.tolist())
    assert state["notice"] == ""
    assert state["values"] == pytest.approx(values, abs=1e-5)
    dependent = dict(zip([n for n in robot.joints if n not in robot.rows], state["dependent"], strict=True))
    assert len(dependent) == len(robot.joints) - len(robot.independent) > 0
    q = page.q(page.values)
    span, _ = model.spanning(q, np.zeros(model.nv))
    at_rest, _ = model.spanning(model.standing_q, np.zeros(model.nv))
    for joint, value in dependent.items():
        row = robot.spanning_rows[joint][0][0]
        assert value == pytest.approx(span[row], abs=1e-5)
    assert np.abs(span - at_rest).max() > 0.05
    assert model.from_spanning(span, np.zeros(robot.layout.nv + len(dependent)))[0] == pytest.approx(q, abs=1e-9)


def test_a_slider_stops_where_a_loop_opens() -> None:
    page = RobotPage(load_robot("dr_legs"))
    index = next(i for i, slider in enumerate(page.sliders) if slider["name"] == "left_shank_inner")
    target = page.standing.copy()
    target[index] = page.sliders[index]["high"]
    state = ask(page, target.tolist())
    assert "do not close" in state["notice"]
    reached = page.values[index]
    assert page.standing[index] + 0.1 < reached < target[index] - 0.1
    assert np.delete(page.values, index) == pytest.approx(np.delete(page.standing, index))
    target[index] = reached + 1e-3
    with pytest.raises(ValueError, match="clos"):
        page.model.body_poses(page.q(target))
    assert ask(page, page.standing.tolist())["notice"] == ""
    assert page.values == pytest.approx(page.standing)


def test_values_beyond_the_range_are_clipped_and_other_messages_refused() -> None:
    page = RobotPage(load_robot("mini_cheetah"))
    high = [slider["high"] for slider in page.sliders]
    assert ask(page, [99.0] * 12)["values"] == pytest.approx(high, abs=1e-5)
    messages: list[dict] = [
        {"do": "move", "values": [0.0] * 11},
        {"do": "move", "values": [float("nan")] * 12},
        {"do": "move", "values": ["0"] * 12},
        {"do": "jump"},
        {"do": "move", "speed": 1},
    ]
    for message in messages:
        with pytest.raises(ValueError, match="expected"):
            page.receive(json.dumps(message).encode())


def test_a_robot_without_contacts_stands_on_its_lowest_shape_and_wheels_turn(tmp_path: Path) -> None:
    page = RobotPage(load_robot(PUP))
    assert page._origin[2] == pytest.approx(0.33, abs=0.02)  # thigh and shank of 0.16 m, foot of 0.02 m
    (tmp_path / "cart.urdf").write_text(WHEEL)
    page = RobotPage(load_robot(tmp_path / "cart.urdf"))
    (slider,) = page.sliders
    assert (slider["name"], slider["link"], slider["limits"]) == ("axle", "wheel", [None, None])
    assert (slider["low"], slider["high"]) == pytest.approx((-np.pi, np.pi))


def test_a_ball_joint_has_three_sliders_of_its_rotation_vector() -> None:
    page = RobotPage(with_balls(True, position=(-float("inf"), 1.0)))
    assert [slider["name"] for slider in page.sliders[:4]] == ["a x", "a y", "a z", "c x"]
    assert (page.sliders[0]["low"], page.sliders[0]["high"]) == (-1.0, 1.0)
    values = np.zeros(len(page.sliders))
    values[1] = 0.5
    ask(page, values.tolist())
    assert page.q(page.values)[7:11] == pytest.approx([np.cos(0.25), 0, np.sin(0.25), 0])


@pytest.mark.parametrize("name", ["robot.urdf", "robot.yaml", "mini_cheetah"])
def test_the_kind_of_file_decides(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_text(PUP.read_text())
    Path("robot.yaml").write_text("name: pup\nurdf: robot.urdf\nbase: floating\n")
    served: list[tuple[str, bool]] = []

    def record(page: LivePage, verb: str, *, open_browser: bool) -> None:
        served.append((page.html().partition("<title>")[2].partition("</title>")[0], open_browser))

    monkeypatch.setattr("ce_gym.viewer.stream.serve", record)
    monkeypatch.setattr("ce_gym.viewer.preparing.GRACE", 60.0)
    assert main(["view", name]) == main(["view", name, "--no-open"]) == 0
    assert served == [("mini_cheetah" if name == "mini_cheetah" else "pup", opens) for opens in (True, False)]


def read(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        return answer.read().decode()


def test_the_page_opens_before_the_robot_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ce_gym.viewer.preparing.GRACE", 0.01)
    is_compiled = threading.Event()

    def make() -> RobotPage:
        assert is_compiled.wait(60)
        return RobotPage(load_robot("mini_cheetah"))

    page = Preparing("cheetah & co", make)
    with serving(page) as url:
        assert "compiling" in read(url)
        assert "<h1>cheetah &amp; co</h1>" in read(url)
        with urllib.request.urlopen(f"{url}events", timeout=60) as events:
            is_compiled.set()
            while b"data:" not in events.readline():
                pass
        assert "MeshCat.Viewer" in read(url)
        page.receive(json.dumps({"do": "move", "values": [0.0] * 12}).encode())


def test_errors_before_and_after_the_page_opens_reach_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ce_gym.viewer.preparing.GRACE", 60.0)
    with pytest.raises(RobotError, match="nobody"):
        Preparing("nobody", lambda: RobotPage(load_robot("nobody")))
    monkeypatch.setattr("ce_gym.viewer.preparing.GRACE", 0.0)
    is_open = threading.Event()

    def fail() -> LivePage:
        assert is_open.wait(60)
        raise RobotError("robot.urdf: broken")

    page = Preparing("late", fail)
    with serving(page):
        is_open.set()
        with pytest.raises(RobotError, match="broken"):
            page.wait()


@pytest.fixture(scope="module")
def browser() -> Iterator[Chromium]:
    if PROGRAM is None:
        pytest.skip("no Chromium here: install chromium (Debian's package) to run this")
    with serving(RobotPage(load_robot("cassie"))) as url, Chromium(f"{url}#contacts") as browser:
        browser.until("received > 0")
        yield browser
        assert not browser.errors


@pytest.mark.slow
def test_a_slider_moves_the_robot_and_its_loops(browser: Chromium) -> None:
    model = Model("cassie")
    index = model.joint_names.index("left_shin_joint")
    count = browser.run("received")
    browser.run(f"sliders[{index}].value = STANDING[{index}] - 0.15; sliders[{index}].oninput()")
    browser.until(f"received > {count} && Math.abs(state.values[{index}] - STANDING[{index}] + 0.15) < 1e-4")
    q = model.standing_q.copy()
    q[7 + index] -= 0.15
    positions, _ = model.body_poses(q)
    found = browser.run(
        """(() => { viewer.scene.updateMatrixWorld(); const places = {}; node('/world/0').object.traverse(object => {
            const place = object.getWorldPosition(new THREE.Vector3());
            places[object.name] = node('/world').object.worldToLocal(place).toArray();
        }); return places; })()"""
    )
    for name, position in zip(model.body_names, positions, strict=True):
        np.testing.assert_allclose(found[name], position, atol=2e-4, err_msg=name)
    browser.run("find('standing').click()")
    browser.until(f"Math.abs(state.values[{index}] - STANDING[{index}]) < 1e-4")
    assert browser.run("find('dependent').rows.length") == len(model.robot.joints) - len(model.robot.independent)


@pytest.mark.slow
def test_boxes_show_overlays_and_the_centre_of_mass_is_the_model_s(browser: Chromium) -> None:
    visible = "kind => overlayNodes(kind).every(object => object.visible)"
    assert browser.run(f"({visible})('contacts')") is True  # by the address
    for kind in ("frames", "inertia", "collision", "center"):
        assert browser.run(f"({visible})('{kind}')") is False
        browser.run(f"find('{kind}').click()")
        assert browser.run(f"({visible})('{kind}')") is True
    browser.settle()
    model = Model("cassie")
    q = np.concatenate([model.standing_q[:7], browser.run("state.values")])
    found = browser.run("overlayNodes('center')[0].position.toArray()")
    np.testing.assert_allclose(found, model.center_of_mass(q), atol=2e-4)
