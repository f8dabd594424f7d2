"""An HTTP server on the loopback interface that serves one page until it is closed.

meshcat's own server is not used: it listens on every network interface and runs as another process.

Only browsers on this machine that know the address can read the page. The address has a random part, which pages of
other sites cannot guess. Requests with another host name, or from a page of another origin, are refused.
"""

from __future__ import annotations

import contextlib
import re
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

LOOPBACK = "127.0.0.1"
MOST_CLIENTS = 16  # connections at a time, each with a thread; further ones are closed
PATIENCE = 10.0  # a connection without traffic is closed after this time [s]
MOST_BYTES = 1 << 14  # of a message from a page
MOST_MESSAGES = 500  # per second

Events = Callable[[], Iterator[bytes]]
Receive = Callable[[bytes], None]


class PageServer:
    """Serves one page at a free loopback port until it is closed.

    Args:
        text: The page, or a function that returns it at each request.
        events: Returns the server-sent events of the address `events` for one browser; None for a page without.
        receive: Takes the body of each message posted to `messages`, in the thread of its connection; raises
            ValueError for an invalid message. None for a page that posts nothing.

    Attributes:
        url: Address of the page.
    """

    def __init__(
        self, text: str | Callable[[], str], events: Events | None = None, receive: Receive | None = None
    ) -> None:
        path = f"/{secrets.token_urlsafe(16)}/"
        self._stop = threading.Event()
        server = _Server((LOOPBACK, 0), _handler(text if callable(text) else lambda: text, path, events, receive))
        self.url = f"http://{LOOPBACK}:{server.server_port}{path}"
        self._thread = threading.Thread(target=_serve, args=(server, self._stop), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ask the server to end, without waiting: finalizers may run in the thread of the server."""
        self._stop.set()

    def close(self) -> None:
        """Stop the server and free its port; may be called again."""
        self.stop()
        self._thread.join()


def _serve(server: _Server, stop: threading.Event) -> None:
    """Accept connections until `stop` is set."""
    with server:
        while not stop.is_set():
            server.handle_request()


class _Server(ThreadingHTTPServer):
    """A server with a limited number of threads, silent about browsers that disconnect."""

    daemon_threads = True
    timeout = 0.05  # between two checks of `stop` [s]

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._places = threading.BoundedSemaphore(MOST_CLIENTS)
        self._lock, self._second, self._count = threading.Lock(), 0, 0

    def may_post(self) -> bool:
        """Return whether another message is allowed in this second."""
        with self._lock:
            second = int(time.monotonic())
            self._count = self._count + 1 if second == self._second else 1
            self._second = second
            return self._count <= MOST_MESSAGES

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for a connection, or close the connection if there are too many."""
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report errors other than broken connections."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)


def _handler(
    text: Callable[[], str], path: str, events: Events | None, receive: Receive | None
) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"  # posts of a page share a connection
        timeout = PATIENCE

        def do_GET(self) -> None:
            if self._is_foreign():
                self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            elif self.path == f"{path}events" and events is not None:
                self._send_events(events())
            elif self.path == path:
                body = text().encode("utf-8")
                self._send_head("text/html; charset=utf-8", len(body))
                self.wfile.write(body)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            server: Any = self.server
            if self._is_foreign():
                self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            elif self.path != f"{path}messages" or receive is None:
                self.send_error(HTTPStatus.NOT_FOUND)
            elif not re.fullmatch("[0-9]{1,9}", length) or int(length) > MOST_BYTES:
                self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            elif not server.may_post():
                self.send_error(HTTPStatus.TOO_MANY_REQUESTS)
            else:
                try:
                    receive(self.rfile.read(int(length)))
                except ValueError as error:
                    self.send_error(HTTPStatus.BAD_REQUEST, explain=" ".join(str(error).split()))
                    return
                self.send_response(HTTPStatus.NO_CONTENT)
                self.end_headers()

        def _is_foreign(self) -> bool:
            """Return whether the request names another host, or comes from a page of another origin."""
            server: Any = self.server
            host, origins = self.headers.get("Host"), self.headers.get_all("Origin", [])
            ours = host in (f"{LOOPBACK}:{server.server_port}", f"localhost:{server.server_port}")
            return not ours or any(origin != f"http://{host}" for origin in origins)

        def _send_head(self, kind: str, length: int | None = None) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Cache-Control", "no-store")
            self.send_header("Referrer-Policy", "no-referrer")
            if length is None:  # a stream ends with its connection
                self.send_header("Connection", "close")
            else:
                self.send_header("Content-Length", str(length))
            self.end_headers()

        def _send_events(self, items: Iterator[bytes]) -> None:
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2**16)  # to notice slow browsers
            self.close_connection = True
            self._send_head("text/event-stream")
            with contextlib.closing(items):  # type: ignore[type-var]
                for item in items:
                    self.wfile.write(item)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    return Handler
