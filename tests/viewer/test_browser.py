"""The page in a real browser: it loads from a file, moves, has working controls, and draws its objects."""

from __future__ import annotations

import base64
import csv
import io
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import PROGRAM, Chromium

from ce_gym import Terrain
from ce_gym.dynamics import Model
from ce_gym.viewer import Rollout, write_html
from ce_gym.viewer.page.html import page
from ce_gym.viewer.rollouts.ground_patch import around
from ce_gym.viewer.server import PageServer

pytest.importorskip("meshcat")
Image = pytest.importorskip("PIL.Image")
pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium here: install chromium (Debian's package) to run this"),
    pytest.mark.slow,
]

ROBOT = "mini_cheetah"
SECONDS, STEP = 17.0, 0.02


def rollout(label: str, lead: float = 0.0) -> Rollout:
    """Trots on the spot it moves along; the torque of the first joint is at its limit, all others are zero."""
    model = Model(ROBOT)
    times = STEP * np.arange(round(SECONDS / STEP) + 1)
    q = np.tile(model.standing_q, (len(times), 1))
    q[:, 7:] += 0.3 * np.sin(6 * times + lead)[:, None]
    q[:, 0] = 0.3 * times + lead
    torques = np.zeros((len(times), 12))
    torques[:, 0] = model.robot.body(model.robot.independent[0]).joint.torque
    forces = np.zeros((len(times), len(model.contact_names), 3))
    forces[:, :, 2] = 10.0
    commands = np.tile([0.3, 0.0, 0.0], (len(times), 1))
    return Rollout(
        ROBOT, "exact", STEP, times, q, np.gradient(np.zeros((len(times), model.nv)), axis=0), forces, commands,
        torques, np.sin(times)[:, None], ["reward"], label,
    )  # fmt: skip


@pytest.fixture(scope="module")
def twins() -> list[Rollout]:
    return [rollout("exact"), rollout("armature", lead=0.25)]


@pytest.fixture(scope="module")
def file(twins: list[Rollout], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_html(twins, tmp_path_factory.mktemp("page") / "twins.html", spacing=0.0)


@pytest.fixture(scope="module")
def browser(file: Path):
    with Chromium(file.as_uri(), size=(900, 700)) as browser:
        yield browser


@pytest.fixture
def at_rest(browser: Chromium) -> Chromium:
    browser.run("seek(1.0)")
    browser.settle()
    return browser


def pixels(browser: Chromium, path: Path) -> np.ndarray:
    browser.settle()
    return np.asarray(Image.open(browser.picture(path)).convert("RGB"), int)


def click(browser: Chromium, selector: str) -> None:
    browser.run(f"document.querySelector('{selector}').click()")


def toggled(browser: Chromium, selector: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pictures before and after a click; a second click restores the page."""
    before = pixels(browser, folder / "before.png")
    click(browser, selector)
    after = pixels(browser, folder / "after.png")
    click(browser, selector)
    return before, after


def count(before: np.ndarray, after: np.ndarray, threshold: int = 40) -> int:
    """Number of pixels that differ by more than a threshold."""
    return int((np.abs(before - after).max(-1) > threshold).sum())


def test_it_needs_nothing_but_its_file(browser: Chromium, file: Path) -> None:
    """A robot and its ghost for 17 s, with forces, torques and commands: 5 MB at most."""
    assert file.stat().st_size <= 5e6
    assert browser.errors == []
    outside = [url for url in browser.requests if not url.startswith(("data:", "blob:", file.as_uri()))]
    assert outside == []
    panel = "getComputedStyle(viewer.gui.domElement).display !== 'none'"
    assert not browser.run(panel)  # meshcat's own
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'c', bubbles: true }))")
    assert browser.run(panel)
    browser.run("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'c', bubbles: true }))")


def test_it_plays_pauses_and_changes_speed(browser: Chromium) -> None:
    browser.run("seek(0); toggle()")
    browser.until("animator.time > 0.1")
    click(browser, "#play")
    browser.settle()
    time = browser.run("animator.time")
    browser.settle()
    assert browser.run("animator.time") == time
    browser.run("find('speed').value = '0.25'; find('speed').onchange({target: find('speed')})")
    assert browser.run("animator.mixer.timeScale") == 0.25
    assert browser.run("find('clock').value").endswith("/ 17.00 s")


def test_bodies_are_where_the_model_says(browser: Chromium, twins: list[Rollout]) -> None:
    """Every body of both robots, the pose as three.js has it, after moving the slider."""
    frame = 37
    browser.run(f"find('time').value = {frame * STEP}; find('time').oninput({{target: find('time')}})")
    model = Model(ROBOT)
    for index, twin in enumerate(twins):
        positions, _ = model.body_poses(twin.q[frame : frame + 1])
        found = browser.run(
            f"""(() => {{
              const root = node("/world/{index}").object, places = {{}};
              root.updateWorldMatrix(true, true);
              root.traverse(object => {{
                const place = object.getWorldPosition(new MeshCat.THREE.Vector3());
                places[object.name] = root.worldToLocal(place).toArray();
              }});
              return places;
            }})()"""
        )
        for name, position in zip(model.body_names, positions[0], strict=True):
            np.testing.assert_allclose(found[name.replace("/", "_")], position, atol=2e-4, err_msg=name)


def test_rotors_turn_and_x_ray_shows_them_in_the_first_robot(at_rest: Chromium, tmp_path: Path) -> None:
    rotor = next(Model(ROBOT).robot.rotors()).name
    turned = f"node('/world/0').object.getObjectByName('{rotor}').quaternion.toArray()"
    before = np.array(at_rest.run(turned))
    at_rest.run("seek(1.3)")
    assert abs(before @ at_rest.run(turned)) < 0.99  # turned by more than 16 degrees
    assert count(*toggled(at_rest, "#xray", tmp_path)) > 1000
    opacities = """(index => { const found = []; node(`/world/${index}`).object.traverse(object => {
        if (object.isMesh && /^link_\\d+$/.test(object.parent.name)) found.push(object.material.opacity); });
        return [...new Set(found)]; })"""
    ghost = at_rest.run(f"{opacities}(1)")
    click(at_rest, "#xray")
    assert at_rest.run(f"{opacities}(1)") == ghost
    assert max(at_rest.run(f"{opacities}(0)")) == pytest.approx(0.3)
    click(at_rest, "#xray")


def test_boxes_hide_robots_and_arrows(at_rest: Chromium, tmp_path: Path) -> None:
    names = at_rest.run("[...document.querySelectorAll('#about > ul > li')].map(item => item.textContent)")
    assert names == ["exact", "armature", "contact forces", "commanded speed", "actual speed"]
    for number in (3, 4, 5):
        box = f"#about li:nth-child({number}) input"
        assert count(*toggled(at_rest, box, tmp_path)) > 100, names[number - 1]
    both, alone = toggled(at_rest, "#about li:nth-child(2) input", tmp_path)
    ghost = (both - alone)[np.abs(both - alone).max(-1) > 15]
    assert len(ghost) > 2000
    assert ghost[:, 0].mean() > ghost[:, 2].mean() + 5  # the first tint is orange
    both, hidden = toggled(at_rest, "#about li:nth-child(1) input", tmp_path)
    rows, columns = np.nonzero(np.abs(both - hidden).max(-1) > 30)
    assert len(rows) > 3000
    assert abs(np.median(columns) - 450) < 150
    assert abs(np.median(rows) - both.shape[0] / 2) < 150
    assert count(both, pixels(at_rest, tmp_path / "again.png"), 30) < 50


def test_overlays_follow_the_first_robot(at_rest: Chromium, twins: list[Rollout], tmp_path: Path) -> None:
    for kind in ("contacts", "frames", "inertia", "collision"):
        assert count(*toggled(at_rest, f"#{kind}", tmp_path)) > 100, kind
    click(at_rest, "#center")
    at_rest.settle()
    (found,) = at_rest.run("overlayNodes('center').map(object => object.position.toArray())")  # none for the ghost
    click(at_rest, "#center")
    np.testing.assert_allclose(found, Model(ROBOT).center_of_mass(twins[0].q[round(1.0 / STEP)]), atol=1e-3)


def test_torque_at_its_limit_is_red(at_rest: Chromium) -> None:
    def colors() -> dict[str, str]:
        return at_rest.run(
            "Object.fromEntries(painted.map(({ color, joint }) => [joint === undefined ? 'none' : joint, "
            "color.getHexString()]))"
        )

    plain = colors()
    click(at_rest, "#torque")
    at_rest.settle()
    shown = colors()
    assert shown.pop("0") == "d7263d"
    assert set(shown.values()) == {"cfd8e1"}
    assert len(shown) == 12  # eleven joints, and the links without a joint
    assert at_rest.run("getComputedStyle(find('scale')).display") == "block"
    click(at_rest, "#torque")
    assert colors() == plain


def test_without_following_the_robot_walks_away(at_rest: Chromium) -> None:
    place = "node('/world').object.position.x"
    assert at_rest.run(place) < -0.2
    click(at_rest, "#follow")
    assert at_rest.run(place) == 0
    click(at_rest, "#follow")
    assert at_rest.run(place) < -0.2


def choose(browser: Chromium, number: int, signal: str) -> None:
    """Choose a signal in the row of that number, counted from the top of all plots."""
    row = f"document.querySelectorAll('.plot select')[{number}]"
    browser.run(f"(select => {{ select.value = '{signal}'; select.onchange(); }})({row})")


def shown(browser: Chromium) -> list[list[str]]:
    """Signals of each plot."""
    rows = "[...plot.querySelectorAll('select')].map(select => select.value)"
    return browser.run(f"[...document.querySelectorAll('.plot')].map(plot => {rows})")


def test_plots_show_both_and_move_time(at_rest: Chromium) -> None:
    at_rest.settle()
    (first,), (second,), (third,) = shown(at_rest)
    assert first == "forward speed [m/s]"
    assert second.startswith("torque of ")
    assert third == "reward"
    values = at_rest.run(
        "[...document.querySelectorAll('.plot:nth-child(3) .values span span')].map(s => s.textContent)"
    )
    np.testing.assert_allclose([float(value) for value in values], np.sin(1.0), atol=1e-3)
    box = at_rest.run("document.querySelector('.plot canvas').getBoundingClientRect().toJSON()")
    left, width = box["x"] + at_rest.run("MARGIN.left"), box["width"] - at_rest.run("MARGIN.left + MARGIN.right")
    middle = box["y"] + box["height"] / 2
    at_rest.drag((left + 5, middle), (left + 0.75 * width, middle))
    assert at_rest.run("animator.time") == pytest.approx(0.75 * SECONDS, abs=0.05)


def test_a_plot_takes_several_signals_and_leaves_files(at_rest: Chromium, twins: list[Rollout], tmp_path: Path) -> None:
    before = shown(at_rest)
    click(at_rest, ".plot .signal button")
    choose(at_rest, 1, "reward")
    assert shown(at_rest) == [["forward speed [m/s]", "reward"], *before[1:]]
    colors = at_rest.run(
        "[...document.querySelectorAll('.plot:first-child .values span[title]')].map(s => s.style.color)"
    )
    assert len(colors) == 5  # two robots and the command, two robots
    assert len(set(colors)) == 3
    table = list(csv.DictReader(at_rest.run("plots.csv()").splitlines()))
    assert [row["source"] for row in table] == [
        name for name in ("exact", "armature") for _ in range(round(SECONDS / STEP) + 1)
    ]
    rewards = [float(row["reward"]) for row in table]
    np.testing.assert_allclose(rewards, np.concatenate([twin.signals[:, 0] for twin in twins]), atol=1e-6)
    np.testing.assert_allclose([float(row["forward speed [m/s], commanded"]) for row in table], 0.3, atol=1e-6)
    url = at_rest.run("plots.png()")
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB"), int)
    assert image.shape[1] == 1800
    for color in ((0x21, 0xA6, 0x59), (0x1F, 0x29, 0x33), (0xD9, 0x48, 0x0F)):
        assert (np.abs(image - color).max(-1) < 30).sum() > 200, color
    click(at_rest, ".plot .signal button[title^=Remove]")
    choose(at_rest, 0, "forward speed [m/s]")
    assert shown(at_rest) == before


def test_zoom_shows_a_part_with_the_present_in_it(at_rest: Chromium) -> None:
    axis = """(draw => { const kept = drawGraph; let told;
        drawGraph = (context, box, plot) => { told = [plot.from, plot.to]; kept(context, box, plot); };
        draw(); drawGraph = kept; return told; })(() => { plots.redraw(); plots.move(animator.time); })"""
    assert at_rest.run(axis) == [0, SECONDS]
    click(at_rest, '.tools button[title^="See less"]')
    start, end = at_rest.run(axis)
    assert end - start == pytest.approx(SECONDS / 1.6)
    assert start < 1.0 < end
    at_rest.run("seek(16.9)")
    start, end = at_rest.run(axis)
    assert start < 16.9 <= end
    click(at_rest, '.tools button[title^="See more"]')
    assert at_rest.run(axis) == [0, SECONDS]


def test_the_address_says_what_to_show(file: Path) -> None:
    with Chromium(file.as_uri() + "#t=2.5&torque&charts=0", size=(900, 700)) as browser:
        browser.until("animator.time === 2.5")
        assert not browser.run("animator.playing")
        assert browser.run("find('torque').checked && !find('charts').checked")
        assert browser.run("find('plots').style.display") == "none"
        assert browser.errors == []


def test_the_live_page_is_the_same_and_a_narrow_window_keeps_all(twins: list[Rollout]) -> None:
    with closing(PageServer(page(twins[:1]))) as server, Chromium(server.url, size=(500, 800)) as browser:
        browser.until("animator.time > 0.1")
        assert browser.errors == []
        assert all(asked.startswith((server.url, "data:")) for asked in browser.requests)
        boxes = browser.run(
            "Object.fromEntries(['about', 'plots', 'bar', 'charts'].map(id => "
            "[id, find(id).getBoundingClientRect().toJSON()]))"
        )
        width, height = browser.run("[innerWidth, innerHeight]")
    for name, box in boxes.items():
        assert box["width"] > 0, name
        assert 0 <= box["left"] <= box["right"] <= width, name
        assert 0 <= box["top"] <= box["bottom"] <= height, name
    assert boxes["about"]["bottom"] < boxes["plots"]["top"]
    assert boxes["plots"]["bottom"] <= boxes["bar"]["top"]


SCAN = [(x, y) for x in (-0.4, 0.1, 0.6) for y in (-0.3, 0.0, 0.3)]
FOOT = {"link": "FL_knee_link", "at": [[0.02, 0.0, -0.19], [-0.02, 0.0, -0.19]], "points": [[0.1, 0.0], [-0.1, 0.05]]}
RAYS = {
    "link": "Floating Base",
    "at": [[0.2, 0.0, 0.05]],
    "rays": [[0.8, 0.0, -0.6], [0.6, 0.64, -0.48], [0.6, 0.0, 0.8]],
}
SCANS = [{"link": "", "at": [[0.0, 0.0, 0.0]], "points": SCAN}, FOOT, {**RAYS, "reach": 1.2, "steps": 24}]


@pytest.fixture(scope="module")
def on_stones(twins: list[Rollout], tmp_path_factory: pytest.TempPathFactory):
    """The first robot and its ghost on rough ground."""
    places = np.concatenate([twin.q[:, :2] for twin in twins])
    ground = around(Terrain.rough(seed=0, amplitude=0.05, size=20.0), places, margin=3.0)
    raised = []
    for twin in twins:
        q = twin.q.copy()
        q[:, 3], q[:, 6] = np.cos(0.25), np.sin(0.25)
        q[:, 2] += ground.at(q[:, 0], q[:, 1])[:, 0]
        raised.append(replace(twin, q=q, ground=ground, scan=SCANS))
    file = write_html(raised, tmp_path_factory.mktemp("stones") / "stones.html", spacing=0.0)
    with Chromium(file.as_uri() + "#t=1", size=(700, 500)) as browser:
        browser.until("fields.length === 1")
        yield browser, ground


def test_the_ground_is_where_the_model_says(on_stones) -> None:
    browser, ground = on_stones
    assert browser.errors == []
    numbers = browser.run("Array.from(fields[0].mesh.geometry.attributes.position.array).slice(0, 3 * 20000)")
    x, y, z = np.reshape(numbers, (-1, 3)).T
    np.testing.assert_allclose(z, ground.at(x, y)[:, 0], atol=1e-5)
    followed = browser.run("fields[0].places.map(place => place.toArray())")
    bases = browser.run("fields[0].bodies.map(path => node(path).object.position.toArray().slice(0, 2))")
    np.testing.assert_allclose(followed, bases)
    same = "node('/world/ground').object.matrixWorld.equals(node('/world/0').object.matrixWorld)"
    assert browser.run(f"(() => {{ viewer.scene.updateMatrixWorld(); return {same}; }})()")


def drawn(ground: Terrain, places: np.ndarray) -> np.ndarray:
    """Heights of the drawn field, which has a vertex at each half cell."""
    half = ground.cell / 2
    low = ground.origin + half * np.floor((places - ground.origin) / half)
    s, t = (places - low).T / half
    z00, z01, z10, z11 = (ground.at(*(low + half * np.array(c)).T)[:, 0] for c in ((0, 0), (0, 1), (1, 0), (1, 1)))
    return (1 - s) * ((1 - t) * z00 + t * z01) + s * ((1 - t) * z10 + t * z11)


def points(browser: Chromium, name: str) -> np.ndarray:
    return np.reshape(browser.run(f"Array.from(fields[0].{name}.geometry.attributes.position.array)"), (-1, 3))


def test_the_height_scan_is_on_the_ground_and_turns_with_the_heading(on_stones) -> None:
    browser, ground = on_stones
    dots = points(browser, "dots")[: len(SCAN)]
    x, y, z, w = browser.run("node(fields[0].bodies[0]).object.quaternion.toArray()")
    base = browser.run("node(fields[0].bodies[0]).object.position.toArray()")
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turned = np.array(SCAN) @ [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
    np.testing.assert_allclose(dots[:, :2], base[:2] + turned, atol=1e-5)
    expected = drawn(ground, dots[:, :2])
    np.testing.assert_allclose(dots[:, 2], expected + 0.01, atol=1e-5)
    assert np.ptp(expected) > 0.01


def test_scans_of_feet_and_rays_end_where_the_sensors_look(on_stones, twins: list[Rollout]) -> None:
    """Against the model's own poses; rays, of which one looks up, end on the ground or at their reach."""
    browser, ground = on_stones
    frame = round(browser.run("animator.time") / STEP)
    q = twins[0].q[frame].copy()
    q[3], q[6] = np.cos(0.25), np.sin(0.25)
    q[2] += ground.at(q[0], q[1])[0]
    model = Model(ROBOT)
    positions, rotations = (dict(zip(model.body_names, rows[0], strict=True)) for rows in model.body_poses(q[None]))
    dots = points(browser, "dots")[len(SCAN) :]
    middle = (positions[FOOT["link"]] + np.array(FOOT["at"]) @ rotations[FOOT["link"]].T).mean(0)
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    np.testing.assert_allclose(dots[:2, :2], middle[:2] + np.array(FOOT["points"]) @ turn, atol=2e-4)
    lines = points(browser, "lines").reshape(-1, 2, 3)
    start = positions[RAYS["link"]] + rotations[RAYS["link"]] @ RAYS["at"][0]
    np.testing.assert_allclose(lines[:, 0], np.tile(start, (3, 1)), atol=2e-4)
    reached = np.linalg.norm(lines[:, 1] - start, axis=1)
    along = np.array(RAYS["rays"]) @ rotations[RAYS["link"]].T
    np.testing.assert_allclose(lines[:, 1], start + reached[:, None] * along, atol=3e-4)
    np.testing.assert_allclose(dots[2:], lines[:, 1] + [0.0, 0.0, 0.01], atol=1e-5)
    assert reached[2] == pytest.approx(1.2, abs=1e-4)
    np.testing.assert_allclose(lines[:2, 1, 2], drawn(ground, lines[:2, 1, :2]), atol=2e-3)  # by regula falsi
    assert (reached[:2] < 1.1).all()


@pytest.mark.parametrize(("part", "least"), [("dots", 20), ("lines", 50), ("mesh", 0.3 * 700 * 500)])
def test_ground_and_scans_are_seen(part: str, least: float, on_stones, tmp_path: Path) -> None:
    browser, _ = on_stones
    with_part = pixels(browser, tmp_path / "with.png")
    browser.run(f"fields[0].{part}.visible = false; viewer.set_dirty()")
    without = pixels(browser, tmp_path / "without.png")
    browser.run(f"fields[0].{part}.visible = true; viewer.set_dirty()")
    assert count(with_part, without, {"dots": 40, "lines": 10, "mesh": 4}[part]) > least


def test_belts_run_with_the_knee(at_rest: Chromium, twins: list[Rollout]) -> None:
    click(at_rest, "#xray")
    strands = "belts.filter(one => one.userData.belt.row && one.userData.belt.links[0].path.startsWith('/world/0'))"
    assert at_rest.run(f"{strands}.length") == 8
    found = []
    for frame in (50, 51):
        at_rest.run(f"seek({frame * STEP})")
        at_rest.settle()
        told = "[belt.row.position.x, belt.pitch, belt.reach, belt.links[0].path]"
        found.append(at_rest.run(f"{strands}.map(({{userData: {{belt}}}}) => {told})"))
    click(at_rest, "#xray")
    model = Model(ROBOT)
    for (before, pitch, reach, path), (after, *_) in zip(*found, strict=True):
        joint = 7 + list(model.robot.independent).index(path.rpartition("/")[2])
        turned = twins[0].q[51, joint] - twins[0].q[50, joint]
        moved = (after - before - reach * turned + pitch / 2) % pitch - pitch / 2  # whole marks look the same
        assert moved == pytest.approx(0, abs=1e-6)
        assert abs(reach * turned) > 1e-4
