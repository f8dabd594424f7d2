"""Events of a live page, and the thread that sends them."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
import webbrowser
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from ce_gym.console import has_display
from ce_gym.viewer.server import PageServer


class Feed:
    """Sends events to all connected browsers; a slow browser misses some.

    Attributes:
        closed: Whether the feed has ended.
    """

    def __init__(self) -> None:
        self._news = threading.Condition(threading.RLock())  # a finalizer may close the feed during a call
        self._event, self._count, self._watchers = b"", 0, 0
        self._kept: dict[str, tuple[int, bytes]] = {}
        self.closed = False

    def publish(self, message: Any) -> bool:
        """Send a message, as JSON, to all connected browsers; return whether there are any."""
        event = b"data: %s\n\n" % json.dumps(message).encode()
        with self._news:
            self._event, self._count = event, self._count + 1
            self._news.notify_all()
            return self._watchers > 0

    def keep(self, kind: str, message: Any) -> None:
        """Send an event named `kind` before the next message, and to every browser that connects later."""
        event = f"event: {kind}\ndata: {json.dumps(message)}\n\n".encode()
        with self._news:
            number = self._kept[kind][0] + 1 if kind in self._kept else 1
            self._kept[kind] = number, event

    def close(self) -> None:
        """End the stream of every browser."""
        with self._news:
            self.closed = True
            self._news.notify_all()

    def events(self) -> Iterator[bytes]:
        """Yield the newest events to one browser until the feed is closed."""
        last_count, received = 0, dict[str, int]()
        with self._news:
            self._watchers += 1
        try:
            while True:
                with self._news:
                    # After a second without news an empty line tests whether the browser is still connected.
                    if not self.closed and self._count == last_count:
                        self._news.wait(timeout=1.0)
                    if self.closed:
                        return
                    event = self._event if self._count > last_count else b":\n\n"
                    last_count = self._count
                    fresh = {kind: kept for kind, kept in self._kept.items() if kept[0] > received.get(kind, 0)}
                    received |= {kind: number for kind, (number, _) in fresh.items()}
                    event = b"".join(kept for _, kept in fresh.values()) + event
                yield event
        finally:
            with self._news:
                self._watchers -= 1


class LivePage:
    """Base class of live pages: one thread simulates and sends, another one compiles and writes files.

    Args:
        name: Name of the threads.

    Attributes:
        feed: The events that browsers receive.
        notice: Message that the page shows.
        error: Error that ended the page.
    """

    def __init__(self, name: str) -> None:
        self.feed, self.notice = Feed(), ""
        self.error: Exception | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._background = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._job: Future[Any] | None = None

    def html(self) -> str:
        """Return the page."""
        raise NotImplementedError

    def events(self) -> Iterator[bytes]:
        """Yield the events for one browser."""
        return self.feed.events()

    def update(self) -> float:
        """Simulate and send; return the time until the next update [s]."""
        raise NotImplementedError

    def receive(self, body: bytes) -> None:
        """Take a message that a browser posted, in a thread of the server.

        Raises:
            ValueError: The message is invalid.
        """
        raise ValueError("this page takes no messages")

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def wait(self) -> None:
        """Wait until the page has ended, and raise its error."""
        self._ended.wait()
        if self.error:
            raise self.error

    def close(self) -> None:
        """Stop the threads, and wait until they have ended."""
        self._ended.set()
        self.feed.close()
        if self._thread.is_alive():
            self._thread.join()
        self._background.shutdown(cancel_futures=True)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            due = max(due + self.update(), time.monotonic())
            self._ended.wait(due - time.monotonic())

    def _finished_job(self) -> Any:
        """Return the result of the background job once, None without one; an error becomes the notice."""
        if self._job is None or not self._job.done():
            return None
        job, self._job = self._job, None
        try:
            result = job.result()
        except Exception as error:  # the page keeps its robots
            self.notice = " ".join(str(error).split())
            return None
        self.notice = ""
        return result


@contextlib.contextmanager
def serving(live: LivePage) -> Iterator[str]:
    """Run a live page and its server; yield the address."""
    with contextlib.closing(live):
        server = PageServer(live.html, live.events, live.receive)
        with contextlib.closing(server):
            live.start()
            yield server.url


def serve(live: LivePage, verb: str, *, open_browser: bool, until_eof: bool = False) -> None:
    """Serve a live page until Ctrl-C.

    Args:
        live: The page.
        verb: First word of the message with the address.
        open_browser: Open a browser, if there is a display.
        until_eof: Serve until the standard input ends instead.
    """
    with contextlib.suppress(KeyboardInterrupt), serving(live) as url:
        print(f"{verb} at {url}" + ("" if until_eof else " (Ctrl-C to stop)"), flush=True)
        if open_browser and has_display():
            webbrowser.open(url, new=2)
        if until_eof:
            sys.stdin.buffer.read()
        else:
            live.wait()
