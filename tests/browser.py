"""A headless Chromium, steered through its DevTools protocol."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from waiting import LONG, until

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless=new", "--no-sandbox", "--no-first-run", "--disable-extensions", "--disable-dev-shm-usage",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--mute-audio",
    "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip


def chromium() -> str | None:
    """Path of the browser, or None."""
    return next((found for name in NAMES if (found := shutil.which(name))), None)


class Browser:
    """One tab at ``url``; use as a context manager."""

    def __init__(self, url: str, profile: Path, width: int = 1280, height: int = 800) -> None:
        self.url, self.profile, self.size = url, profile, (width, height)
        self.numbers, self.stack = itertools.count(), ExitStack()

    def __enter__(self) -> Browser:
        from websockets.sync.client import connect

        program = chromium()
        assert program is not None
        command = [program, *_FLAGS, f"--user-data-dir={self.profile}", f"--window-size={self.size[0]},{self.size[1]}"]
        self.process = subprocess.Popen([*command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            note = self.profile / "DevToolsActivePort"
            until(
                lambda: note.exists() and note.read_text().count("\n"),
                "Chromium's start",
                lambda: self.process.poll() is None,
            )
            port = note.read_text().split("\n")[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=LONG) as answer:
                tab = next(entry for entry in json.load(answer) if entry["type"] == "page")
            self.socket = self.stack.enter_context(connect(tab["webSocketDebuggerUrl"], max_size=None))
            self.call("Page.navigate", url=self.url)
        except BaseException:
            self.process.kill()
            raise
        return self

    def __exit__(self, *_: Any) -> None:
        self.stack.close()
        self.process.terminate()
        self.process.wait(LONG)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol."""
        number = next(self.numbers)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=LONG))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]

    def ask(self, expression: str) -> Any:
        """The value of a JavaScript expression."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def text(self) -> str:
        """What the page says."""
        return self.ask("document.body ? document.body.innerText : ''")

    def click(self, x: float, y: float) -> None:
        """Press and release the left button at (x, y)."""
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, name: str, code: int, times: int = 1) -> None:
        """Press a key that writes nothing."""
        for _ in range(times):
            for kind in ("rawKeyDown", "keyUp"):
                self.call("Input.dispatchKeyEvent", type=kind, key=name, code=name, windowsVirtualKeyCode=code)

    def place(self, expression: str) -> tuple[float, float]:
        """Middle of the element that a JavaScript expression gives, scrolled into view."""
        box = self.ask(
            f"(() => {{ const e = {expression}; if (!e) return null; e.scrollIntoView({{block: 'nearest'}});"
            " const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        assert box is not None, expression
        return box[0], box[1]

    def screenshot(self, file: Path) -> Path:
        """Write what is seen as a PNG."""
        file.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))
        return file
