"""Server-sent events of a live page: the newest poses, and what is kept beside them, such as the ground."""

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
        self._kept: dict[str, tuple[int, bytes]] = {}
        self.closed = False

    def publish(self, event: bytes) -> bool:
        """Send an event to all connected browsers; return whether there are any."""
        with self._news:
            self._event, self._count = event, self._count + 1
            self._news.notify_all()
            return self._watchers > 0

    def keep(self, kind: str, data: bytes) -> None:
        """Send data of a kind before the next event, in an event of that name; browsers that come later get it, too."""
        with self._news:
            number = self._kept[kind][0] + 1 if kind in self._kept else 1
            self._kept[kind] = number, b"event: %s\ndata: %s\n\n" % (kind.encode(), data)

    def close(self) -> None:
        """End the stream of every browser."""
        with self._news:
            self.closed = True
            self._news.notify_all()

    def events(self) -> Iterator[bytes]:
        """Yield the newest poses to one browser until the feed is closed."""
        seen, had = 0, dict[str, int]()
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
                    fresh = {kind: kept for kind, kept in self._kept.items() if kept[0] > had.get(kind, 0)}
                    had |= {kind: number for kind, (number, _) in fresh.items()}
                    event = b"".join(kept for _, kept in fresh.values()) + event
                yield event
        finally:
            with self._news:
                self._watchers -= 1
