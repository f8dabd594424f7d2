"""The server of live pages: access, number of clients, and release of its resources."""

from __future__ import annotations

import gc
import http.client
import socket
import threading
import time
import urllib.parse
import weakref
from collections.abc import Iterator
from contextlib import closing

import gymnasium
import numpy as np
import pytest

from ce_gym.viewer.server import MOST_BYTES, MOST_CLIENTS, MOST_MESSAGES, PageServer
from ce_gym.viewer.stream import Feed


@pytest.fixture
def server() -> Iterator[PageServer]:
    feed = Feed()
    feed.publish(1)
    with closing(PageServer("<p>robot</p>", feed.events)) as server:
        server.feed = feed  # type: ignore[attr-defined]
        yield server
        feed.close()


def ask(server: PageServer, name: str = "", host: str | None = None) -> int:
    """Status of an answer; `name` is added to the address, or replaces its path if it begins with a slash."""
    where = urllib.parse.urlsplit(urllib.parse.urljoin(server.url, name))
    connection = http.client.HTTPConnection("127.0.0.1", where.port or 0, timeout=60)
    with closing(connection):
        connection.request("GET", where.path, headers={"Host": host or where.netloc})
        return connection.getresponse().status


def test_only_whoever_has_the_address_may_look(server: PageServer) -> None:
    """Pages of other sites do not know it: they can neither read the page nor count as somebody who watches."""
    port = urllib.parse.urlsplit(server.url).port
    assert ask(server) == ask(server, host=f"localhost:{port}") == ask(server, "events") == 200
    assert [ask(server, name) for name in ("/", "/events", "/x/events", "other")] == [404] * 4
    with closing(PageServer("")) as other:
        assert urllib.parse.urlsplit(other.url).path != urllib.parse.urlsplit(server.url).path


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1"])
def test_other_names_for_this_machine_are_refused(server: PageServer, host: str) -> None:
    """A name that an attacker lets point here would make our page part of his site."""
    assert ask(server, host=host) == 421
    assert ask(server, "events", host=host) == 421


def post(server: PageServer, body: bytes, **headers: str) -> int:
    """Status of the answer to a message."""
    where = urllib.parse.urlsplit(urllib.parse.urljoin(server.url, "messages"))
    with closing(http.client.HTTPConnection("127.0.0.1", where.port or 0, timeout=60)) as connection:
        connection.putrequest("POST", where.path, skip_host=True)
        sent = {"Host": where.netloc, "Content-Length": str(len(body))} | headers
        for name, value in sent.items():
            connection.putheader(name, value)
        connection.endheaders(body)
        return connection.getresponse().status


def test_messages_from_pages_of_other_origins_are_refused() -> None:
    received: list[bytes] = []
    with closing(PageServer("", receive=received.append)) as server:
        ours = "http://" + urllib.parse.urlsplit(server.url).netloc
        assert post(server, b"{}") == post(server, b"{}", Origin=ours) == 204
        for origin in ("http://evil.example", "null", ours.replace("http", "https"), ours + "0", ""):
            assert post(server, b"{}", Origin=origin) == 421
    assert len(received) == 2


def test_length_and_rate_of_messages_are_limited() -> None:
    received: list[bytes] = []
    with closing(PageServer("", receive=received.append)) as server:
        for length in ("9" * 5000, "-1", "", "1e3", "\u0662".encode().decode("latin-1"), str(MOST_BYTES + 1)):
            assert post(server, b"", **{"Content-Length": length}) == 413
        where = urllib.parse.urlsplit(urllib.parse.urljoin(server.url, "messages"))
        with closing(http.client.HTTPConnection("127.0.0.1", where.port or 0, timeout=60)) as connection:
            statuses = set()
            for _ in range(20 * MOST_MESSAGES):
                connection.request("POST", where.path, b"{}", {"Host": where.netloc})
                answer = connection.getresponse()
                answer.read()
                statuses.add(answer.status)
                if answer.status == 429:
                    break
    assert statuses == {204, 429}


def test_clients_are_limited_in_number(server: PageServer) -> None:
    """Whoever comes when all places are taken is sent away."""
    before = threading.active_count()
    where = urllib.parse.urlsplit(server.url)

    def watch() -> tuple[socket.socket, bytes]:
        one = socket.create_connection(("127.0.0.1", where.port), timeout=60)
        try:
            one.sendall(f"GET {where.path}events HTTP/1.1\r\nHost: {where.netloc}\r\n\r\n".encode())
            return one, one.recv(12)
        except ConnectionError:
            return one, b""

    watching = [watch() for _ in range(2 * MOST_CLIENTS)]
    assert [bool(answer) for _, answer in watching] == [True] * MOST_CLIENTS + [False] * MOST_CLIENTS
    assert threading.active_count() <= before + MOST_CLIENTS
    for one, _ in watching:
        one.close()


def test_browsers_that_leave_are_not_mentioned(capfd: pytest.CaptureFixture[str]) -> None:
    """In the middle of a page, of a request and of events; at once, so that the connection is reset."""
    feed, left = Feed(), []
    with closing(PageServer("x" * 2**24, feed.events)) as server:
        where = urllib.parse.urlsplit(server.url)
        for text in (f"GET {where.path} HTTP/1.1", f"GET {where.path}events HTTP/1.1", "GET"):
            one = socket.create_connection(("127.0.0.1", where.port), timeout=60)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            one.sendall(f"{text}\r\nHost: {where.netloc}\r\n\r\n".encode() if text != "GET" else b"GET")
            if text != "GET":
                one.recv(12)
            one.close()
            left.append(text)
        feed.publish(1)
        threads = [t for t in threading.enumerate() if "process_request_thread" in t.name]
        feed.publish(2)
        feed.close()
        for thread in threads:
            while thread.ident is None:  # listed, but not started yet
                time.sleep(0.001)
            thread.join()
    assert capfd.readouterr().err == ""
    assert len(left) == 3


def test_windows_that_are_dropped_leave_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("meshcat")
    before = set(threading.enumerate())
    env = gymnasium.make("ce_gym/MiniCheetahVelocity-v0", render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(12, np.float32))
    url = urllib.parse.urlsplit(capsys.readouterr().out.split()[-1])
    (thread,) = set(threading.enumerate()) - before
    window = weakref.ref(env.unwrapped._screen._renderer)
    del env
    gc.collect()
    assert window() is None
    thread.join()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", url.port), timeout=60)
