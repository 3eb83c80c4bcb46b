"""Nerfstudio's viewer in a browser: a server of it, and what its page shows."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import count
from pathlib import Path

import numpy as np
from browser import Page
from PIL import Image
from places import ROOT
from run_folders import CLASSES

from beags_plugin.labels.colors import colorize
from beags_plugin.system.child_processes import bound

WIDTH, HEIGHT = 640, 400
MAX_RESOLUTION = 512  # pixels of the longer side, the default of the viewer of a training
COLORS = {name: colorize(np.array([[index]]))[0, 0].astype(int) for index, name in CLASSES.items()}
HEARS = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # tests in the background ignore it
ENTRY = f"{HEARS}; from nerfstudio.scripts.viewer.run_viewer import entrypoint; entrypoint()"  # ns-viewer runs this


def free_port() -> int:
    """Return a port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def started(command: list[object], log: Path, ready: str) -> Iterator[subprocess.Popen]:
    """Yield Python with this checkout's package and these arguments, once it has printed ``ready``; end it.

    log: the file that it prints to, which must hold no traceback at the end.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])}
    with open(log, "wb") as out:
        words = bound([sys.executable, *command], signal.SIGKILL)
        process = subprocess.Popen(words, stdout=out, stderr=subprocess.STDOUT, env=environment)
    try:
        end = time.monotonic() + 300
        while ready not in log.read_text():
            assert process.poll() is None and time.monotonic() < end, log.read_text()[-3000:]
            time.sleep(0.2)
        yield process
        process.terminate()
        process.wait(120)
    finally:
        process.kill()  # The test may have failed, or the process not ended.
        process.wait()
    assert "Traceback" not in log.read_text()


@contextmanager
def viewed(config: Path, log: Path) -> Iterator[str]:
    """Yield the address of ns-viewer of a run, and end it by Ctrl-C."""
    port = free_port()
    options = ("--load-config", config, "--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port)
    with started(["-c", ENTRY, *options], log, "disabled local writer") as process:  # the last that it prints
        yield f"http://127.0.0.1:{port}"
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert log.read_text().rstrip().endswith("The viewer is closed.")


def picture(page: Page) -> np.ndarray:
    """Return the picture left of the panel, below the title, without the cross of axes; [H, W, 3] int."""
    pixels = np.asarray(Image.open(BytesIO(page.picture())).convert("RGB"))
    return pixels[60:340, :310].astype(int)


def differing(one: np.ndarray, other: np.ndarray) -> float:
    """Return the share of the pixels that differ by more than what JPEG does to them."""
    return float((np.abs(one - other).max(axis=2) > 40).mean())


def varied(pixels: np.ndarray) -> float:
    """Measure how much a picture varies over its pixels; 0 for one colour."""
    return float(pixels.reshape(-1, 3).std(axis=0).max())


def painted(pixels: np.ndarray, name: str) -> float:
    """Return the share of the pixels that have the colour of a class."""
    return float((np.abs(pixels - np.array(COLORS[name])).max(axis=2) < 30).mean())


def sharp(page: Page) -> bool:
    """Return whether the picture has the full resolution; coarse ones, which the panel shows too, come before it."""
    found = re.search(r"Resolution: (\d+)x(\d+)px", page.text())
    if found is None:
        return False
    trains = re.search("(Pause|Resume) Training", page.text())
    longest = MAX_RESOLUTION if trains else max(canvas_size(page))
    return abs(max(int(found[1]), int(found[2])) - longest) <= 1


def canvas_size(page: Page) -> tuple[int, int]:
    """Return width and height of the canvas that the picture fills, pixels of the page."""
    canvas = "document.querySelector('canvas[data-engine]')"
    return tuple(page.evaluate(f"[{canvas}.clientWidth, {canvas}.clientHeight]"))


STILL = 1.0  # seconds that a picture must stay as it is: the page names its size before it has decoded it


def awaited(page: Page, true: Callable[[np.ndarray], bool], act: str | Callable[[], None] | None = None) -> np.ndarray:
    """Return the picture, once it is as asked for and stays so.

    act: the button that makes it so, or a function; done again after a while, as a panel that is put together anew
    hears nothing.
    """
    found, looks, since = [picture(page)], count(), time.monotonic()

    def holds() -> bool:
        nonlocal since
        if act is not None and next(looks) % 40 == 0:
            page.press(act) if isinstance(act, str) else act()
        found[:] = [found[-1], picture(page)]
        if differing(*found) > 0.0 or not true(found[-1]):
            since = time.monotonic()
        return time.monotonic() - since > STILL and sharp(page)

    try:
        page.wait(holds)
    except AssertionError as error:
        described = f"the picture varies by {varied(found[-1]):.2f}, mean {found[-1].mean():.1f}"
        raise AssertionError(f"{described}; {error}") from None
    return found[-1]


def slid(page: Page, label: str, value: float, true: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Move a slider until the picture is as asked for; see ``awaited``."""
    moves = count()

    def move() -> None:
        if next(moves):  # a field that has the value already tells nobody
            page.slide(label, value + 0.01)
            time.sleep(1.0)
        page.slide(label, value)

    return awaited(page, true, move)
