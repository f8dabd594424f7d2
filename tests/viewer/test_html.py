"""The page is one self-contained file; its server is on the loopback only, and ends with the call."""

from __future__ import annotations

import base64
import io
import json
import re
import socket
import sys
import urllib.error
import urllib.parse
import urllib.request
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hopper import StandIn, make_robot, make_rollout

from ce_gym.viewer import show, write_html
from ce_gym.viewer.page import three
from ce_gym.viewer.page.html import page
from ce_gym.viewer.page.lights_and_camera import ground_image
from ce_gym.viewer.server import PageServer

umsgpack = pytest.importorskip("umsgpack")
pytest.importorskip("meshcat")


@pytest.fixture
def model() -> StandIn:
    return StandIn(make_robot())


def test_page_needs_nothing_from_outside(tmp_path: Path, model: StandIn) -> None:
    path = write_html(make_rollout(), tmp_path / "walk.html", models=[model])
    text = path.read_text(encoding="utf-8")
    xml_names = {"http://www.w3.org/1999/xhtml", "http://www.w3.org/2000/svg"}
    assert set(re.findall(r"https?://[^\s\"'\\)]+", text)) <= xml_names
    assert not re.search(r"<(script|img|iframe)[^>]*\ssrc=|<link\b(?![^>]*href=.data:)|@import", text)
    assert list(tmp_path.iterdir()) == [path]


def test_twenty_seconds_are_small_and_a_large_page_warns(
    tmp_path: Path, model: StandIn, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    path = tmp_path / "walk.html"
    assert write_html(make_rollout(1000), path, models=[model]).stat().st_size < 2e6
    assert not recwarn.list
    monkeypatch.setattr("ce_gym.viewer.page.html.LARGE", 1000)
    size = write_html(make_rollout(1000), path, models=[model]).stat().st_size
    expected = f"{path}: the page has {size / 1e6:.1f} MB; fewer seconds, robots or frames (max_fps) make it smaller"
    assert str(recwarn.pop(UserWarning).message) == expected


def test_page_holds_the_scene_and_is_the_same_every_time(model: StandIn) -> None:
    text = page(make_rollout(), models=[model])
    assert text == page(make_rollout(), models=[model])
    constant = re.search(r"^const COMMANDS = (\[.*\]);$", text, re.MULTILINE)
    assert constant
    commands = [umsgpack.unpackb(base64.b64decode(item)) for item in json.loads(constant.group(1))]
    assert {c["type"] for c in commands} == {"set_object", "set_property", "set_transform", "set_animation"}
    track = commands[-1]["animations"][1]["clip"]["tracks"][0]
    assert track["values"].type == 0x17
    values = np.frombuffer(track["values"].data, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(values, make_rollout().q[:, :3], atol=1e-6)


def test_text_is_escaped(model: StandIn) -> None:
    text = page(make_rollout(label="<b>$x</script>"), models=[model], title="</title><script>")
    assert "<b>$x" not in text
    assert text.count("</script>") == page(make_rollout(), models=[model]).count("</script>")
    assert "&lt;b&gt;$x" in text
    assert "<title>&lt;/title&gt;" in text


def test_image_is_a_valid_png() -> None:
    image = pytest.importorskip("PIL.Image").open(io.BytesIO(three.png(ground_image(8))))
    np.testing.assert_array_equal(np.asarray(image), ground_image(8))


def test_a_page_is_served_on_loopback_only_and_then_gone() -> None:
    with closing(PageServer("<p>robot</p>")) as server:
        url, port = server.url, urllib.parse.urlsplit(server.url).port or 0
        with urllib.request.urlopen(url, timeout=5) as answer:
            assert answer.read() == b"<p>robot</p>"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(url + "etc/passwd", timeout=5)
        if sys.platform == "linux":  # all of 127/8 is this machine, so a server on every interface would answer
            with pytest.raises(OSError, match="refused"):
                socket.create_connection(("127.0.0.2", port), timeout=2)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=2)


def test_show_stops_by_itself(model: StandIn, capsys: pytest.CaptureFixture[str]) -> None:
    show(make_rollout(), models=[model], seconds=0.05)
    assert "http://127.0.0.1:" in capsys.readouterr().out
