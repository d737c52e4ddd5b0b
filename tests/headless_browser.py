"""Chromium without a window, driven over a pipe: no port, no driver, no network."""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM = next((path for name in NAMES if (path := shutil.which(name))), None)
_PATIENCE_S = 60.0
# copied out of the way first, since one of them may be the other's place
_LAUNCHER = """
import fcntl, os, sys
high = [fcntl.fcntl(int(fd), fcntl.F_DUPFD_CLOEXEC, 10) for fd in sys.argv[1:3]]
os.dup2(high[0], 3)
os.dup2(high[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class HeadlessBrowser:
    """One page in a headless Chromium, offline, with software WebGL. A context manager.

    It speaks the DevTools protocol on file descriptors 3 and 4: JSON, each message ended by NUL.
    """

    def __init__(self, *flags: str) -> None:
        self._profile = tempfile.mkdtemp(prefix="report-test-")
        for_browser, self._to_browser = os.pipe()
        self._from_browser, by_browser = os.pipe()
        options = [
            "--headless=new", "--no-sandbox", "--no-first-run", "--hide-scrollbars",
            "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
            f"--user-data-dir={self._profile}", "--remote-debugging-pipe",
        ]  # fmt: skip
        self._process = subprocess.Popen(
            [sys.executable, "-c", _LAUNCHER, str(for_browser), str(by_browser), CHROMIUM,
             *options, *flags, "about:blank"],
            pass_fds=(for_browser, by_browser),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(for_browser)
        os.close(by_browser)
        self._unread, self._count, self._session = b"", 0, None
        self.events: list[dict[str, Any]] = []
        try:
            target = self.call("Target.createTarget", url="about:blank")["targetId"]
            attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
            self._session = attached["sessionId"]
            for domain in ("Page", "Runtime", "Log", "Network"):
                self.call(f"{domain}.enable")
            self.call(
                "Network.emulateNetworkConditions",
                offline=True, latency=0, downloadThroughput=0, uploadThroughput=0,
            )  # fmt: skip
        except Exception:
            self.close()
            raise

    def __enter__(self) -> HeadlessBrowser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._to_browser)
        os.close(self._from_browser)
        shutil.rmtree(self._profile, ignore_errors=True)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the protocol, and its answer."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to_browser, json.dumps(message).encode() + b"\0")
        while (answer := self._receive()).get("id") != self._count:
            self.events.append(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def evaluate(self, expression: str) -> Any:
        """The value of JavaScript, awaited if it is a promise."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def open(self, path: Path, *, width: int = 1280, height: int = 900) -> None:
        """Loads a file and waits for its first picture."""
        self.events.clear()
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.call("Page.navigate", url=path.as_uri())
        ready = (
            f"location.href === {json.dumps(path.as_uri())} && document.readyState === 'complete'"
            " && (document.body.dataset.viewer !== 'ready' || document.body.dataset.rendered > 0)"
        )
        end = time.monotonic() + _PATIENCE_S
        while not self.evaluate(ready):
            assert time.monotonic() < end, "the page does not come to rest"
            time.sleep(0.05)
        self.settle()

    def settle(self) -> None:
        """Waits until what was asked for is on the screen."""
        self.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")

    def complaints(self) -> list[dict[str, Any]]:
        """Exceptions, console messages and log entries since `open`."""
        kinds = ("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
        return [event for event in self.events if event["method"] in kinds]

    def requests(self) -> list[str]:
        """Every address asked for since `open`, without what is in the page itself."""
        sent = [e for e in self.events if e["method"] == "Network.requestWillBeSent"]
        addresses = [event["params"]["request"]["url"] for event in sent]
        return [address for address in addresses if not address.startswith("data:")]

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def screenshot(self, box: dict[str, float]) -> np.ndarray:
        """Pixels [height, width, 3] f32 of a box of the page: x, y, width, height."""
        answer = self.call(
            "Page.captureScreenshot", format="png", captureBeyondViewport=True,
            clip={**box, "scale": 1},
        )  # fmt: skip
        return imread(io.BytesIO(base64.b64decode(answer["data"])))[..., :3]

    def _receive(self) -> dict[str, Any]:
        end = time.monotonic() + _PATIENCE_S
        while b"\0" not in self._unread:
            ready, _, _ = select.select([self._from_browser], [], [], end - time.monotonic())
            assert ready, "the browser does not answer"
            piece = os.read(self._from_browser, 1 << 20)
            assert piece, "the browser has gone"
            self._unread += piece
        message, _, self._unread = self._unread.partition(b"\0")
        return json.loads(message)
