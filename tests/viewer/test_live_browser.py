"""The live page in a real browser, driven by key events and drags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import PROGRAM, Chromium

from ce_gym.viewer.live.runner import Runner
from ce_gym.viewer.live.setup import named
from ce_gym.viewer.stream import serving

pytest.importorskip("meshcat")
pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no Chromium here: install chromium (Debian's package) to run this"),
    pytest.mark.slow,
]

BASE = """(place => [(1 + place.x) / 2 * innerWidth, (1 - place.y) / 2 * innerHeight])(
    bodies[0][0].getWorldPosition(new THREE.Vector3()).project(viewer.camera))"""
"""Where in the window the middle of the base is."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with (
        serving(Runner(named("mini_cheetah_velocity"), tmp_path_factory.mktemp("live"))) as url,
        Chromium(url) as browser,
    ):
        browser.until("received > 3")
        yield browser
        assert not browser.errors


def test_keys_drive_it(browser: Chromium):
    browser.key("keyDown", "w")
    browser.until("state.command[0] > 0.5 && state.base.velocity[0] > 0.3")
    browser.key("keyUp", "w")
    browser.until("state.command[0] === 0")


def test_the_stick_turns_it(browser: Chromium):
    browser.run("find('stick').scrollIntoView()")
    x, y = browser.run("(b => [b.x + b.width / 2, b.y + b.height / 2])(find('stick').getBoundingClientRect())")
    browser.mouse("mousePressed", x - 40, y)
    browser.until("state.command[2] > 0.3")
    browser.mouse("mouseReleased", x - 40, y)
    browser.until("state.command[2] === 0")


def test_overlays_and_rotors_are_seen(browser: Chromium):
    browser.run("['xray', 'contacts', 'center'].forEach(kind => find(kind).click())")
    browser.settle()
    assert browser.run("overlayNodes('contacts').every(group => group.visible)") is True
    assert browser.run("node('/world/0').object.getObjectByName('inside').visible") is True
    assert browser.run("overlayNodes('center')[0].position.z") == pytest.approx(0.27, abs=0.08)
    browser.run("['xray', 'contacts', 'center'].forEach(kind => find(kind).click())")


def test_a_drag_pulls_the_body_that_is_seen_there(browser: Chromium):
    x, y = browser.run(BASE)
    browser.mouse("mousePressed", x, y)
    assert browser.run("bodyOf(drag.object)[1] === drag.body") is True
    height = "node('/world').object.worldToLocal(body.getWorldPosition(new THREE.Vector3())).z"
    before = browser.run(f"var body = drag.object; {height}")
    browser.mouse("mouseMoved", x, y - 200)
    browser.until(f"state.pulled === drag.body && {height} > {before} + 0.04")
    browser.mouse("mouseReleased", x, y - 200)
    browser.until("state.pulled === null")
    assert browser.run("viewer.controls.enabled") is True


def test_time_can_be_stopped_and_gone_back_in(browser: Chromium):
    browser.until("state.kept > 1")
    browser.key("keyDown", " ")
    browser.until("state.paused")
    browser.run("find('past').value = -0.5; find('past').oninput({target: find('past')})")
    browser.until("state.back > 0.4")
    browser.key("keyDown", " ")
    browser.until("!state.paused && state.back < 0.1")


def test_what_it_asks_for_is_what_the_session_offers(browser: Chromium, tmp_path: Path):
    browser.run("find('friction').value = 0.3; find('friction').oninput({target: find('friction')})")
    browser.until("state.figures.friction === 0.3")
    browser.run("find('policy').value = ''; find('policy').onchange({target: find('policy')})")
    browser.until("state.setup.policy === ''")
    assert browser.run("document.getElementById('notice').textContent") == ""
