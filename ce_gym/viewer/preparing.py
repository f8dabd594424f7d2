"""A live page that opens while its robot is compiled."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

from ce_gym.viewer.page.html import waiting_page
from ce_gym.viewer.stream import LivePage

GRACE = 1.0  # a page that is ready earlier is shown at once, and errors until then are raised at once [s]
PERIOD = 0.05  # between two checks for the page [s]


class Preparing(LivePage):
    """Shows a waiting page until another live page is ready, then that page.

    Args:
        title: Title of the waiting page.
        make: Returns the other page; runs in a thread of its own.

    Raises:
        Exception: The error of `make` in the first second. A later error is raised by `wait`.
    """

    def __init__(self, title: str, make: Callable[[], LivePage]) -> None:
        super().__init__("prepare")
        self._title, self._is_announced = title, False
        self._page: LivePage | None = None
        # A daemon: Ctrl-C does not wait for the compiler.
        maker = threading.Thread(target=self._make, args=(make,), daemon=True)
        maker.start()
        maker.join(GRACE)
        if self.error:
            raise self.error

    def _make(self, make: Callable[[], LivePage]) -> None:
        try:
            self._page = make()
        except Exception as error:
            self.error = error

    def html(self) -> str:
        """Return the page, or the waiting page."""
        return self._page.html() if self._page else waiting_page(self._title)

    def events(self) -> Iterator[bytes]:
        """Yield the events of the page to one browser; before, one message once the page is ready."""
        return self._page.events() if self._page else self.feed.events()

    def receive(self, body: bytes) -> None:
        """Pass a message on to the page."""
        (self._page or super()).receive(body)

    def update(self) -> float:
        """Update the page; return the time until the next update [s]."""
        if self.error:
            self._ended.set()
        if self._page is None:
            return PERIOD
        if not self._is_announced:
            self._is_announced = True
            self.feed.publish("ready")
        return self._page.update()

    def close(self) -> None:
        """Stop the threads and close the page."""
        super().close()
        if self._page:
            self._page.close()
