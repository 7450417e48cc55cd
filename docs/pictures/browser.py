"""A Chromium without a window, where one is installed, told what to do over a pipe.

By its DevTools protocol a page has any width: a window may have a least one, of 500 px.
"""

from __future__ import annotations

import base64
import functools
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

NAMES = (
    "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome",
    "chromium-headless-shell", "headless_shell", "microsoft-edge",
)  # fmt: skip
PLAYWRIGHTS = (
    "chromium-*/chrome-*/chrome",
    "chromium_headless_shell-*/chrome-*/*headless*shell",
    "chromium-*/chrome-mac*/*.app/Contents/MacOS/*",
)
MACS = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
)
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
    "--disable-dev-shm-usage", "--proxy-server=127.0.0.1:9", "--remote-debugging-pipe",
)  # fmt: skip
"""The proxy is nobody: what is not of this machine is not reached."""
LONGEST_S = 60.0
# The protocol's pipe is file 3 for what the browser reads and 4 for what it writes.
LAUNCH = """
import fcntl, os, sys
read, write = (fcntl.fcntl(int(fd), fcntl.F_DUPFD, 10) for fd in sys.argv[1:3])
os.dup2(read, 3)
os.dup2(write, 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class BrowserError(Exception):
    """It did not do what it was told."""


def find_browser() -> str | None:
    """A Chromium of the system's, or else one that playwright fetched."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    named = os.environ.get("PLAYWRIGHT_BROWSERS_PATH")
    home = Path.home()
    for folder in (named, home / ".cache/ms-playwright", home / "Library/Caches/ms-playwright"):
        for pattern in PLAYWRIGHTS if folder else ():
            for path in sorted(Path(str(folder)).glob(pattern), reverse=True):
                if os.access(path, os.X_OK) and path.is_file():
                    return str(path)
    return next((mac for mac in MACS if os.access(mac, os.X_OK)), None)


@functools.cache
def why_no_browser() -> str:
    """Empty where one is installed that opens a page and answers."""
    path = find_browser()
    if path is None:
        return "no Chromium is installed"
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text("<title>seen</title>", encoding="utf-8")
        try:
            with browsing(path) as browser:
                browser.open(page.as_uri(), 400, 300)
                browser.until("document.title == 'seen'", 20.0)
        except (BrowserError, OSError) as error:
            return f"{path} shows no page: {error}"
    return ""


class Browser:
    """One page of a browser that runs."""

    def __init__(self, to_fd: int, from_fd: int) -> None:
        self._to_fd, self._from_fd = to_fd, from_fd
        self._number, self._buffer, self._session = 0, b"", ""
        made = self._ask("Target.createTarget", url="about:blank")
        attached = self._ask("Target.attachToTarget", targetId=made["targetId"], flatten=True)
        self._session = attached["sessionId"]

    def open(self, url: str, width_px: int, height_px: int) -> None:
        """Begin to show a page in a window of that inner size."""
        self._ask(
            "Emulation.setDeviceMetricsOverride",
            width=width_px, height=height_px, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        answer = self._ask("Page.navigate", url=url)
        if answer.get("errorText"):
            raise BrowserError(f"{url}: {answer['errorText']}")
        # A page with a live picture is never complete.
        self.until("document.readyState != 'loading' && location.href != 'about:blank'")

    def evaluate(self, expression: str) -> Any:
        """What a JavaScript expression gives in the page."""
        answer = self._ask("Runtime.evaluate", expression=expression, returnByValue=True)
        if "exceptionDetails" in answer:
            raise BrowserError(f"{expression}: {answer['exceptionDetails'].get('text')}")
        return answer["result"].get("value")

    def until(self, expression: str, longest_s: float = LONGEST_S) -> None:
        end_s = time.monotonic() + longest_s
        while not self.evaluate(f"!!({expression})"):
            if time.monotonic() > end_s:
                raise BrowserError(f"not within {longest_s:g} s: {expression}")
            time.sleep(0.02)

    def photograph(self) -> NDArray[np.uint8]:
        """(height, width, 3), blue first."""
        png = base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(image, np.uint8)

    def _ask(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        call = {"id": self._number, "method": method, "params": params}
        if self._session:
            call["sessionId"] = self._session
        data = json.dumps(call).encode() + b"\0"
        while data:
            data = data[os.write(self._to_fd, data) :]
        end_s = time.monotonic() + LONGEST_S
        while True:
            told = self._next(end_s)
            if told.get("id") != self._number:
                continue
            if "error" in told:
                raise BrowserError(f"{method}: {told['error'].get('message')}")
            return dict(told["result"])

    def _next(self, end_s: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._from_fd], [], [], max(0.0, end_s - time.monotonic()))
            data = os.read(self._from_fd, 1 << 16) if ready else b""
            if not data:
                raise BrowserError("it hung up" if ready else "no answer")
            self._buffer += data
        told, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(told))


@contextmanager
def browsing(path: str | None = None) -> Iterator[Browser]:
    """A browser for as long as the block lasts, with a profile of its own."""
    path = path or find_browser()
    assert path is not None
    to_read, to_write = os.pipe()
    from_read, from_write = os.pipe()
    # What it leaves behind as it is ended may still be written to.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [
                sys.executable, "-c", LAUNCH, str(to_read), str(from_write), path, *FLAGS,
                f"--user-data-dir={profile}",
            ],
            pass_fds=(to_read, from_write), stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_read)
        os.close(from_write)
        try:
            yield Browser(to_write, from_read)
        finally:
            os.close(to_write)  # without its pipe it ends by itself
            os.close(from_read)
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10.0)
