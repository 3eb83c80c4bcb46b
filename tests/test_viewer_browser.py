"""ns-viewer as a user sees it: the real command, in a headless Chromium."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from browser import Page, chromium

from beags_plugin.extraction.ply import read_ply

pytestmark = pytest.mark.skipif(chromium() is None, reason="there is no chromium (Debian: apt-get install chromium)")
ENTRY = "from nerfstudio.scripts.viewer.run_viewer import entrypoint; entrypoint()"  # what ns-viewer runs


@pytest.fixture
def served(tmp_path):
    """The config.yml of a run, the address of its viewer, and the file that the viewer prints to."""
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = tmp_path / "log.txt"
    options = ("--load-config", config, "--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), *sys.path[1:]])}
    with open(log, "wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-c", ENTRY, *map(str, options)], stdout=out, stderr=subprocess.STDOUT, env=environment
        )
    end = time.monotonic() + 500
    while "disabled local writer" not in log.read_text():  # the last that it prints
        assert process.poll() is None and time.monotonic() < end, log.read_text()[-3000:]
        time.sleep(0.5)
    yield config, f"http://127.0.0.1:{port}", log
    process.terminate()
    process.wait()


def test_objects_are_isolated_picked_and_exported(served):
    config, url, log = served
    with Page(url, 1100, 1300) as page:
        text = page.wait_for_text("Export what is shown", 120)
        assert all(name in text for name in ("background", "cup", "box", "Show all objects", "Least opacity"))
        page.choose("Object", "cup")
        page.press("Isolate")
        page.wait(lambda: page.evaluate("[...document.querySelectorAll('del')].map(e => e.innerText).join()") != "")
        assert page.evaluate("[...document.querySelectorAll('del')].map(e => e.innerText).join()") == "background,box"
        for output in ("class_map", "boundary_error", "mask_before", "rgb"):
            page.choose("Output type", output)
        page.press("Export what is shown")
        page.wait_for_text("Exported to")
        page.click(30, 600)  # the viewer opens amid the scene, and the cup is all around
        page.wait_for_text("Picked: cup")
    surfels, classes = read_ply(config.parent / "exports/shown_cup.ply")
    assert len(surfels) == 25 and set(classes.tolist()) == {1}
    assert "Traceback" not in log.read_text()
