"""Server-sent events of a live page: the newest poses and the ground around the robots."""

from __future__ import annotations

import threading
from collections.abc import Iterator


class Feed:
    """Sends events to all connected browsers; a slow one misses some.

    Attributes:
        closed: Whether it has ended.
    """

    def __init__(self) -> None:
        self._news = threading.Condition(threading.RLock())  # a finalizer may close it amid a call
        self._event, self._count, self._watchers = b"", 0, 0
        self._ground, self._grounds = b"", 0
        self.closed = False

    def publish(self, event: bytes) -> bool:
        """Send an event to all connected browsers; return whether there are any."""
        with self._news:
            self._event, self._count = event, self._count + 1
            self._news.notify_all()
            return self._watchers > 0

    def put_ground(self, event: bytes) -> None:
        """Send another piece of ground before the next event."""
        with self._news:
            self._ground, self._grounds = event, self._grounds + 1

    def close(self) -> None:
        """End the stream of every browser."""
        with self._news:
            self.closed = True
            self._news.notify_all()

    def events(self) -> Iterator[bytes]:
        """Yield the newest poses to one browser until the feed is closed."""
        seen = grounds = 0
        with self._news:
            self._watchers += 1
        try:
            while True:
                with self._news:
                    # Without news for a second, an empty line finds out whether the browser is still there.
                    if not self.closed and self._count == seen:
                        self._news.wait(timeout=1.0)
                    if self.closed:
                        return
                    event, seen = (self._event, self._count) if self._count > seen else (b":\n\n", seen)
                    if self._grounds > grounds:
                        event, grounds = self._ground + event, self._grounds
                yield event
        finally:
            with self._news:
                self._watchers -= 1
