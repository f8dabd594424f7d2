"""Pages served on this machine's loopback for as long as a call lasts.

meshcat's own server is not used: it listens on every network interface, runs as another process that outlives its
window, and takes one blocking message at a time. The page carries the whole animation, so a plain HTTP server inside
this process does, and there is nothing to leave behind.

Who may look: browsers of this machine that were given the address. It has a random part, so that pages of other sites
cannot guess it, and requests that came here by another name than the loopback's are refused.
"""

from __future__ import annotations

import contextlib
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from ce_gym.viewer.page.html import page
from ce_gym.viewer.rollouts.rollout import Rollout

LOOPBACK = "127.0.0.1"
MOST_CLIENTS = 16  # connections at a time, a thread each; more are closed at once
PATIENCE = 10.0  # of a connection over which nothing comes or goes [s]
MOST_BYTES = 1 << 14  # of a message from a page

Events = Callable[[], Iterator[bytes]]
Receive = Callable[[bytes], None]


def show(
    rollouts: Rollout | Sequence[Rollout],
    *,
    open_browser: bool = False,
    seconds: float | None = None,
    **options: Any,
) -> None:
    """Play rollouts in browsers on this machine, in real time and over and over, until Ctrl-C.

    Args:
        rollouts: What to show; several stand side by side.
        open_browser: Open a browser at the page.
        seconds: Stop by itself after this time [s].
        options: Title, models, spacing and frame rate; see `ce_gym.viewer.page.html.page`.

    Raises:
        ViewerError: meshcat is not installed, or a rollout does not fit its robot.
    """
    with contextlib.closing(PageServer(page(rollouts, **options))) as server, contextlib.suppress(KeyboardInterrupt):
        print(f"playing at {server.url} (Ctrl-C to stop)", flush=True)
        if open_browser:
            webbrowser.open(server.url, new=2)
        threading.Event().wait(seconds)


class PageServer:
    """Serves one page at a free loopback port until it is closed.

    Args:
        text: The page.
        events: Gives what the page's browsers get as server-sent events from `events`; none if not given.
        receive: Is given what browsers post to `messages`, in a thread of theirs; raises ValueError for what makes no
            sense. None if not given.

    Attributes:
        url: Address of the page.
    """

    def __init__(self, text: str, events: Events | None = None, receive: Receive | None = None) -> None:
        path = f"/{secrets.token_urlsafe(16)}/"
        self._stop = threading.Event()
        server = _Server((LOOPBACK, 0), _handler(text.encode("utf-8"), path, events, receive))
        self.url = f"http://{LOOPBACK}:{server.server_port}{path}"
        self._thread = threading.Thread(target=_serve, args=(server, self._stop), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Let the server end soon, and do not wait: for finalizers, which may run in any thread, its own included."""
        self._stop.set()

    def close(self) -> None:
        """Stop the server and free its port; harmless if done before."""
        self.stop()
        self._thread.join()


def _serve(server: _Server, stop: threading.Event) -> None:
    """Take connections until told to stop."""
    with server:
        while not stop.is_set():
            server.handle_request()


class _Server(ThreadingHTTPServer):
    """A server whose threads are limited in number, and that says nothing of browsers that leave."""

    daemon_threads = True
    timeout = 0.05  # between two looks at whether to stop [s]

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give a connection a thread, or close it if there are too many."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection, in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Be silent about connections that broke; all else is a mistake of ours."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def _handler(body: bytes, path: str, events: Events | None, receive: Receive | None) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"  # who posts often keeps the connection
        timeout = PATIENCE

        def do_GET(self) -> None:
            if not self._is_for_us():
                self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            elif self.path == f"{path}events" and events is not None:
                self._send_events(events())
            elif self.path == path:
                self._send_head("text/html; charset=utf-8", len(body))
                self.wfile.write(body)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not self._is_for_us():
                self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            elif self.path != f"{path}messages" or receive is None:
                self.send_error(HTTPStatus.NOT_FOUND)
            elif not length.isdecimal() or int(length) > MOST_BYTES:
                self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            else:
                try:
                    receive(self.rfile.read(int(length)))
                except ValueError as problem:
                    self.send_error(HTTPStatus.BAD_REQUEST, explain=" ".join(str(problem).split()))
                    return
                self.send_response(HTTPStatus.NO_CONTENT)
                self.end_headers()

        def _is_for_us(self) -> bool:
            server: Any = self.server
            port = server.server_port
            return self.headers.get("Host") in (f"{LOOPBACK}:{port}", f"localhost:{port}")

        def _send_head(self, kind: str, length: int | None = None) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            if length is None:  # it ends with its connection
                self.send_header("Connection", "close")
            else:
                self.send_header("Content-Length", str(length))
            self.end_headers()

        def _send_events(self, items: Iterator[bytes]) -> None:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**16)  # who does not read is seen soon
            self.close_connection = True
            self._send_head("text/event-stream")
            with contextlib.closing(items):  # type: ignore[type-var]
                for item in items:
                    self.wfile.write(item)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: requests are of no interest to whoever watches."""

    return Handler
