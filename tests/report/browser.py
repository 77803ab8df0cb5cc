"""Chromium without a window, spoken to over a pipe (the DevTools protocol): what a page asks for, says and shows."""

import base64
import contextlib
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)


class Page:
    """One open page; `requests` and `complaints` hold what it asked the network for and what it complained of."""

    def __init__(self, reader: Any, writer: Any) -> None:
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self._reader, self._writer, self._count = reader, writer, 0
        self._session: str | None = None
        target = self._ask("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self._ask(f"{domain}.enable")

    def open(self, file: Path, *, width: int = 1200, height: int = 900, scheme: str = "light", media: str = "") -> None:
        """Show a file in a window of that size and colour scheme, or as another medium shows it."""
        self._ask(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self._ask("Emulation.setEmulatedMedia", media=media, features=features)
        self._loaded = False
        self._ask("Page.navigate", url=file.resolve().as_uri())
        while not self._loaded:
            self._hear()

    def ask_script(self, script: str) -> Any:
        """The value of an expression in the page."""
        answer = self._ask("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, script: str, seconds: float = 20.0) -> None:
        """Until an expression in the page is true."""
        end = time.monotonic() + seconds
        while not self.ask_script(f"Boolean({script})"):
            assert time.monotonic() < end, f"in vain: {script}"
            time.sleep(0.05)

    def move_pointer(self, x: float, y: float) -> None:
        """Put the pointer there."""
        self._ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def picture(self, file: Path) -> None:
        """The whole page as PNG."""
        shot = self._ask("Page.captureScreenshot", captureBeyondViewport=True, format="png")
        file.write_bytes(base64.b64decode(shot["data"]))

    def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._writer.write(json.dumps(message).encode() + b"\0")
        self._writer.flush()
        while True:
            answer = self._hear()
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    def _hear(self) -> dict[str, Any]:
        text = bytearray()
        while (byte := self._reader.read(1)) != b"\0":
            assert byte, "Chromium has hung up"
            text += byte
        message = json.loads(text)
        told = message.get("params", {})
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requests.append(told["request"]["url"])
            case "Runtime.exceptionThrown":
                self.complaints.append(told["exceptionDetails"]["text"])
            case "Log.entryAdded":
                self.complaints.append(told["entry"]["text"])
            case "Runtime.consoleAPICalled":
                self.complaints.append(str(told["args"]))
            case "Page.loadEventFired":
                self._loaded = True
        return message


@contextlib.contextmanager
def chromium() -> Iterator[Page]:
    """A page in a fresh Chromium, which ends with the block."""
    assert CHROMIUM is not None
    to_it, from_it = os.pipe(), os.pipe()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:  # its helpers may still write there
        redirected = f'exec "$@" 3<&{to_it[0]} 4>&{from_it[1]}'
        process = subprocess.Popen(
            ["bash", "-c", redirected, "chromium", CHROMIUM, *FLAGS, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=(to_it[0], from_it[1]),
            stderr=subprocess.DEVNULL,
        )
        os.close(to_it[0])
        os.close(from_it[1])
        with os.fdopen(to_it[1], "wb") as writer, os.fdopen(from_it[0], "rb") as reader:
            try:
                yield Page(reader, writer)
            finally:
                process.terminate()
                process.wait(20)
