"""The page: one file, complete in itself; the live page: on loopback only, gone when the call ends."""

from __future__ import annotations

import base64
import importlib.util
import json
import re
import socket
import struct
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
import zlib
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hopper import StandIn, make_robot, make_rollout

from ce_gym.viewer import ViewerError, show, write_html
from ce_gym.viewer.page import three
from ce_gym.viewer.page.html import page
from ce_gym.viewer.page.lights_and_camera import ground_image
from ce_gym.viewer.server import PageServer

umsgpack = pytest.importorskip("umsgpack")
pytest.importorskip("meshcat")


def commands_in(text: str) -> list[dict]:
    found = re.search(r"^const commands = (\[.*\]);$", text, re.MULTILINE)
    assert found
    return [umsgpack.unpackb(base64.b64decode(item)) for item in json.loads(found.group(1))]


@pytest.fixture
def model() -> StandIn:
    return StandIn(make_robot())


def test_page_needs_nothing_from_outside(tmp_path: Path, model: StandIn) -> None:
    path = write_html(make_rollout(), tmp_path / "walk.html", models=[model])
    text = path.read_text(encoding="utf-8")
    assert set(re.findall(r"https?://[^\s\"'\\)]+", text)) <= {
        "http://www.w3.org/1999/xhtml",  # names in XML
        "http://www.w3.org/2000/svg",
    }
    assert not re.search(r"<(script|img|iframe)[^>]*\ssrc=|<link\b(?![^>]*href=.data:)|@import", text)
    assert list(tmp_path.iterdir()) == [path]


def test_a_large_page_says_what_takes_how_much(
    tmp_path: Path, model: StandIn, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    options = {"models": [model], "max_fps": 1000.0}
    small = write_html(make_rollout(frames=20), tmp_path / "small.html", **options).stat().st_size
    assert not recwarn.list
    monkeypatch.setattr("ce_gym.viewer.page.html.LARGE", small)
    large = write_html(make_rollout(frames=2000, step=0.002), tmp_path / "large.html", **options).stat().st_size
    told = str(recwarn.pop(UserWarning).message)
    assert told.startswith(f"{tmp_path / 'large.html'}: {large / 1e6:.1f} MB, of which ")
    assert "\n" not in told
    figures = {words: float(figure) for words, figure in re.findall(r"(movements|plots|ground|viewer) (\d+\.\d)", told)}
    assert len(figures) == 4
    assert sum(figures.values()) == pytest.approx(large / 1e6, abs=0.25)
    assert figures["movements"] + figures["plots"] == pytest.approx((large - small) / 1e6, abs=0.15)


def test_page_holds_the_scene(model: StandIn) -> None:
    commands = commands_in(page(make_rollout(), models=[model]))
    assert {c["type"] for c in commands} == {"set_object", "set_property", "set_transform", "set_animation"}
    track = commands[-1]["animations"][1]["clip"]["tracks"][0]
    assert track["values"].type == 0x17
    values = np.frombuffer(track["values"].data, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(values, make_rollout().q[:, :3], atol=1e-6)


def test_page_is_the_same_every_time(model: StandIn) -> None:
    assert page(make_rollout(), models=[model]) == page(make_rollout(), models=[model])


def test_text_is_escaped(model: StandIn) -> None:
    text = page(make_rollout(label="<b>$x</script>"), models=[model], title="</title><script>")
    assert "<b>$x" not in text
    assert text.count("</script>") == page(make_rollout(), models=[model]).count("</script>")
    assert "&lt;b&gt;$x" in text
    assert "<title>&lt;/title&gt;" in text


def test_twenty_seconds_are_small(tmp_path: Path) -> None:
    path = write_html(make_rollout(1000), tmp_path / "walk.html", models=[StandIn(make_robot())])
    assert path.stat().st_size < 2e6


def test_image_is_a_valid_png() -> None:
    pixels = ground_image(8)
    data = three.png(pixels)
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks[kind] = body
        at += 12 + length
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(8, 25)
    assert not rows[:, 0].any()
    np.testing.assert_array_equal(rows[:, 1:].reshape(8, 8, 3), pixels)


def test_missing_meshcat_is_said_in_one_line(model: StandIn, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ViewerError, match=r'needs meshcat.*pip install "ce_gym\[viewer\]"') as caught:
        page(make_rollout(), models=[model])
    assert "\n" not in str(caught.value)


def test_no_process_is_started_and_meshcat_not_imported() -> None:
    code = """
import sys
sys.path.insert(0, sys.argv[1])
import subprocess
def forbidden(*args, **kwargs): raise AssertionError("started a process")
subprocess.Popen = forbidden
from hopper import StandIn, make_robot, make_rollout
from ce_gym.viewer.page.html import page
page(make_rollout(), models=[StandIn(make_robot())])
assert not {"meshcat", "zmq", "IPython", "tornado"} & set(sys.modules)
"""
    here = str(Path(__file__).parent)
    done = subprocess.run([sys.executable, "-c", code, here], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def connect(host: str, port: int) -> None:
    socket.create_connection((host, port), timeout=2).close()


def test_live_page_is_served_on_loopback_only_and_then_gone() -> None:
    with closing(PageServer("<p>robot</p>")) as server:
        url, port = server.url, urllib.parse.urlsplit(server.url).port
        with urllib.request.urlopen(url, timeout=5) as answer:
            assert answer.read() == b"<p>robot</p>"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(url + "etc/passwd", timeout=5)
        if sys.platform == "linux":  # all of 127/8 is this machine, so a server on every interface would answer
            with pytest.raises(OSError, match="refused"):
                connect("127.0.0.2", port)
    with pytest.raises(OSError, match="refused"):
        connect("127.0.0.1", port)


def test_show_stops_by_itself(model: StandIn, capsys: pytest.CaptureFixture[str]) -> None:
    show(make_rollout(), models=[model], seconds=0.05)
    assert "http://127.0.0.1:" in capsys.readouterr().out
