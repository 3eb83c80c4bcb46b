"""A page in a headless Chromium, driven over its debugging protocol."""

from __future__ import annotations

import base64
import json
import shutil
import signal
import subprocess
import tempfile
import time
import urllib.request
from contextlib import suppress
from itertools import count
from pathlib import Path

import pytest
from websockets.sync.client import connect

from beags_plugin.system.child_processes import bound

_FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--hide-scrollbars", "--no-first-run", "--mute-audio", "--remote-debugging-port=0",
)  # fmt: skip


def browser() -> str | None:
    """Return the program of a Chromium, or None."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


NEEDED = pytest.mark.skipif(
    browser() is None,
    reason="there is no Chromium, so nobody looks at the viewer in a browser (Debian: apt install chromium)",
)
"""Mark of tests that open a page."""


SECONDS = 120.0  # A wait that takes longer has failed; most end long before, even on a busy machine.


def _labelled(label: str) -> str:
    """Return JavaScript for the control that a label belongs to."""
    labels = "[...document.querySelectorAll('label')]"
    return f"document.getElementById({labels}.find(l => l.innerText.trim() == {json.dumps(label)})?.htmlFor)"


class Page:
    """One page at ``url``; a context manager that ends the browser."""

    def __init__(self, url: str, width: int = 1280, height: int = 800) -> None:
        program = browser()
        assert program is not None, "there is no Chromium (Debian: apt install chromium)"
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        command = [program, *_FLAGS, f"--user-data-dir={self._profile.name}", f"--window-size={width},{height}", url]
        self._process = subprocess.Popen(
            bound(command, signal.SIGKILL), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            port = self._wait_for(lambda: (Path(self._profile.name) / "DevToolsActivePort").read_text().split()[0])
            target = self._wait_for(lambda: self._page_target(port))
            self._socket = connect(target, max_size=None, compression=None)
            self._number = 0
            self.asked: list[str] = []  # addresses that the page has asked for since ``follow``
            self.resize(width, height)
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_) -> None:
        self._socket.close()
        self._end()

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._profile.cleanup()

    @staticmethod
    def _page_target(port: str) -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=5) as reply:
            return next(page["webSocketDebuggerUrl"] for page in json.load(reply) if page["type"] == "page")

    @staticmethod
    def _wait_for(ask, seconds: float = SECONDS):
        end = time.monotonic() + seconds
        while True:
            try:
                return ask()
            except (OSError, StopIteration, IndexError):
                if time.monotonic() > end:
                    raise
                time.sleep(0.2)

    def _send(self, method: str, **parameters) -> dict:
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            reply = json.loads(self._socket.recv(timeout=SECONDS))
            if reply.get("method") == "Network.requestWillBeSent":
                self.asked.append(reply["params"]["request"]["url"])
            if reply.get("id") == self._number:
                if "error" in reply:
                    raise RuntimeError(f"{method}: {reply['error']}")
                return reply["result"]

    def follow(self, url: str) -> None:
        """Go to ``url``, and keep what it asks for in ``asked``."""
        self._send("Network.enable")
        self._send("Page.navigate", url=url)
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            with suppress(RuntimeError):  # Between two pages, no page answers.
                if self.evaluate("document.readyState == 'complete' && location.href") == url:
                    return
            time.sleep(0.2)
        raise TimeoutError(f"{url} was not loaded within {SECONDS:g} s")

    def evaluate(self, script: str):
        """Return the value of a JavaScript expression."""
        found = self._send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"])
        return found["result"].get("value")

    def text(self) -> str:
        """Return all text that the page shows."""
        return self.evaluate("document.body?.innerText") or ""

    def wait(self, true, seconds: float = SECONDS) -> None:
        """Wait until a function returns true."""
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, self.text()
            time.sleep(0.3)

    def wait_for_text(self, wanted: str, seconds: float = SECONDS) -> str:
        """Return the page's text, once ``wanted`` is part of it."""
        self.wait(lambda: wanted in self.text(), seconds)
        return self.text()

    def click(self, x: float, y: float) -> None:
        """Press and release the left button."""
        self.drag((x, y), (x, y))

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
        """Press a button of the mouse, move it in a few steps, release it."""
        path = [[a + (b - a) * step / 8 for a, b in zip(start, end, strict=True)] for step in range(9)]
        kinds = ["mouseMoved", "mousePressed", *["mouseMoved"] * 7, "mouseReleased"]
        for kind, (x, y) in zip(kinds, [path[0], *path], strict=True):
            pressed = {} if (kind, x, y) == ("mouseMoved", *start) else {"button": button, "clickCount": 1}
            held = {"left": 1, "right": 2}[button] if pressed and kind != "mouseReleased" else 0
            self._send("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=held, **pressed)
            time.sleep(0.03)

    def bottom(self, label: str) -> float:
        """Return how far down the button of that name reaches, pixels."""
        button = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() == {json.dumps(label)})"
        return self.evaluate(f"{button}.getBoundingClientRect().bottom")

    def resize(self, width: int, height: int) -> None:
        """Set the page's size, pixels."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1}
        self._send("Emulation.setDeviceMetricsOverride", **size, mobile=False)

    def press(self, label: str) -> None:
        """Press the button of that name, once it is there; not with the mouse: the panel may still be moving."""
        button = f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() == {json.dumps(label)})"
        self.wait(lambda: self.evaluate(f"(() => {{ const b = {button}; b?.click(); return Boolean(b); }})()"))

    def open_tab(self, label: str) -> None:
        """Open the tab of that name, once it is there."""
        tab = f"[...document.querySelectorAll('[role=tab]')].find(t => t.innerText.trim() == {json.dumps(label)})"
        self.wait(lambda: self.evaluate(f"(() => {{ const t = {tab}; t?.click(); return Boolean(t); }})()"))

    def write(self, label: str, text: str) -> None:
        """Write into the text field beside ``label``, which names none by its id."""
        found = f"[...document.querySelectorAll('label')].find(l => l.innerText.trim() == {json.dumps(label)})"
        done = (
            f"(() => {{ let e = {found}; while (e && !e.querySelector('input')) e = e.parentElement;"
            " if (!e) return false; const input = e.querySelector('input');"
            " Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value')"
            f".set.call(input, {json.dumps(text)});"
            " input.dispatchEvent(new Event('input', {bubbles: true})); return true; })()"
        )
        self.wait(lambda: self.evaluate(done))

    def tick(self, label: str) -> None:
        """Tick or untick the box called ``label``, the first of that name."""
        self._wait_for_control(label)
        self.evaluate(f"{_labelled(label)}.click()")

    def choose(self, label: str, option: str) -> None:
        """Choose an option of the drop-down list called ``label``."""
        listed = (
            "[...document.querySelectorAll('[role=option]')]"
            f".find(o => o.innerText.trim() == {json.dumps(option)} && o.offsetParent)"
        )
        tries = count()

        def done() -> bool:
            if self.chosen(label) == option:
                return True
            if next(tries) % 10 == 0:  # again after a while: a panel that is put together anew closes the list
                self.evaluate(f"{_labelled(label)}?.click()")  # A mouse could miss: the panel may still be moving.
            self.evaluate(f"{listed}?.click()")
            return False

        self.wait(done)

    def chosen(self, label: str) -> str | None:
        """Return the choice that the drop-down list called ``label`` shows; None while there is none."""
        return self.evaluate(f"{_labelled(label)}?.value")

    def _wait_for_control(self, label: str) -> None:
        """Wait for a control, which a panel lacks for a moment while it is put together anew."""
        self.wait(lambda: self.evaluate(f"Boolean({_labelled(label)})"))

    def slide(self, label: str, value: float) -> None:
        """Write into the number field beside the slider called ``label``."""
        self._wait_for_control(label)
        self.evaluate(
            f"(() => {{ const e = {_labelled(label)}.parentElement.querySelector('input[type=text]');"
            " Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value')"
            f".set.call(e, '{value}'); e.dispatchEvent(new Event('input', {{bubbles: true}})); }})()"
        )

    def picture(self) -> bytes:
        """Return the page as a PNG file's content."""
        return base64.b64decode(self._send("Page.captureScreenshot", format="png")["data"])
