"""Live playback: the page of a rollout served on this machine's loopback for as long as the call lasts.

meshcat's own server is not used: it listens on every network interface, runs as another process that outlives its
window, and takes one blocking message at a time. The page carries the whole animation, so a plain HTTP server inside
this process does, and there is nothing to leave behind. Knows how to make a page and how to serve it.
"""

from __future__ import annotations

import contextlib
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from ce_gym.viewer.page.html import page
from ce_gym.viewer.rollouts.rollout import Rollout

LOOPBACK = "127.0.0.1"


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
    with serve(page(rollouts, **options)) as url, contextlib.suppress(KeyboardInterrupt):
        print(f"playing at {url} (Ctrl-C to stop)", flush=True)
        if open_browser:
            webbrowser.open(url, new=2)
        threading.Event().wait(seconds)


@contextlib.contextmanager
def serve(text: str, events: Callable[[], Iterator[bytes]] | None = None) -> Iterator[str]:
    """Serve one page at a free loopback port inside the context, which gets its address.

    Args:
        text: The page.
        events: Gives what the page's browsers get as server-sent events from `/events`; none if not given.
    """
    server = ThreadingHTTPServer((LOOPBACK, 0), _handler(text.encode("utf-8"), events))
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    try:
        yield f"http://{LOOPBACK}:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _handler(body: bytes, events: Callable[[], Iterator[bytes]] | None) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path == "/events" and events is not None:
                self._send_events(events())
                return
            if self.path != "/":
                self.send_error(HTTPStatus.NOT_FOUND)
                return
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def _send_events(self, items: Iterator[bytes]) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/event-stream")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            with contextlib.closing(items), contextlib.suppress(ConnectionError):  # type: ignore[type-var]
                for item in items:
                    self.wfile.write(item)

        def log_message(self, format: str, *args: object) -> None:
            """Say nothing: requests are of no interest to whoever watches."""

    return Handler
