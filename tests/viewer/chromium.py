"""Drives a real Chromium without a window: opens a page, runs scripts in it, takes pictures.

Speaks the DevTools protocol through a pair of pipes (`--remote-debugging-pipe`), so that no port is opened and no
package is needed.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

PROGRAM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)
OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # containers run tests as root
    "--no-first-run",
    "--disable-background-networking",
    "--use-angle=swiftshader",  # WebGL by the processor
    "--enable-unsafe-swiftshader",
    "--remote-debugging-pipe",
    "--hide-scrollbars",
)


class Chromium:
    """One browser with one page; a context manager.

    Args:
        url: What to open.
        size: Of the window [pixels].

    Attributes:
        requests: Addresses that the page requested.
        errors: Errors of its scripts.
    """

    def __init__(self, url: str, size: tuple[int, int] = (1280, 800)) -> None:
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        out, self._write = os.pipe()  # the browser reads commands from 3 and answers on 4
        self._read, back = os.pipe()
        command = [PROGRAM, *OPTIONS, f"--user-data-dir={self._profile.name}", f"--window-size={size[0]},{size[1]}"]
        script = f'exec "$@" 3<&{out} 4>&{back}'
        self.process = subprocess.Popen(
            ["bash", "-c", script, "bash", *command, "about:blank"],
            pass_fds=(out, back),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(out)
        os.close(back)
        self._count, self._buffer, self.requests, self.errors = 0, b"", [], []
        pages = self._call("Target.getTargets")["targetInfos"]
        page = next(target for target in pages if target["type"] == "page")
        self._session = None
        self._session = self._call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network"):
            self._call(f"{domain}.enable")
        self._call("Page.navigate", url=url)
        self.until("document.readyState === 'complete'")

    _session: str | None = None

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        self._session = None
        self._send("Browser.close")
        try:
            self.process.wait(timeout=20)
        finally:
            self.process.kill()
            for end in (self._read, self._write):
                os.close(end)
            self._profile.cleanup()

    def run(self, script: str) -> Any:
        """Return the value of an expression in the page."""
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise AssertionError(answer["exceptionDetails"]["exception"].get("description", answer))
        return answer["result"].get("value")

    def until(self, script: str, seconds: float = 90.0) -> None:
        """Wait until an expression in the page is true."""
        end = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < end, f"never true: {script}; {self.errors}"
            time.sleep(0.1)

    def settle(self) -> None:
        """Wait until changes are drawn."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => setTimeout(done, 50))))")

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at a place of the window, move it to another and release it [pixels]."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.mouse(kind, x, y)

    def mouse(self, kind: str, x: float, y: float) -> None:
        """Send "mousePressed", "mouseMoved" or "mouseReleased" of the left button at a place of the window [pixels]."""
        self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def key(self, kind: str, character: str) -> None:
        """Send "keyDown" or "keyUp" of a key."""
        self._call("Input.dispatchKeyEvent", type=kind, key=character)

    def picture(self, path: Path) -> Path:
        """Write a picture of the page as a PNG file and return its path."""
        answer = self._call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(answer["data"]))
        return path

    def _send(self, method: str, **parameters: Any) -> int:
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        message |= {"sessionId": self._session} if self._session else {}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        return self._count

    def _call(self, method: str, **parameters: Any) -> Any:
        number = self._send(method, **parameters)
        while True:
            message = self._receive()
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            if message.get("method") == "Network.requestWillBeSent":
                self.requests.append(message["params"]["request"]["url"])
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(message["params"]["exceptionDetails"]["exception"].get("description", message))

    def _receive(self, seconds: float = 90.0) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            assert select.select([self._read], [], [], seconds)[0], "the browser does not answer"
            chunk = os.read(self._read, 1 << 20)
            assert chunk, "the browser has gone"
            self._buffer += chunk
        line, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(line)
