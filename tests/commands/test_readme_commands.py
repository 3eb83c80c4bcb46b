"""The commands of README.md and docs/commands.md, run one after the other in a folder of their own.

Programs are started, but for most commands of beags, which run in this process.

``RUN`` lists commands with flags that make them quick; ``OWN`` replaces the reader's names. ``ELSEWHERE`` lists the
other commands, each with the reason. Together they must be all of both pages.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from called_programs import called
from places import ROOT
from test_documented_commands import code_lines

from beags_plugin.system.child_processes import bound

pytest.importorskip("nerfstudio")

from viewer_pages import free_port

pytestmark = pytest.mark.slow("every command of README, one after the other: three trainings")

BIN = Path(sys.executable).parent
PROGRAM = re.compile(r"(beags|ns-[a-z]+|make|pip|python) |scripts/")
README = "\n".join((ROOT / page).read_text("utf8") for page in ("README.md", "docs/commands.md"))

SHORT = (
    "--vis tensorboard --machine.device-type cpu --pipeline.model.base-steps 60 --pipeline.model.refine-steps 10 "
    "--pipeline.model.prepare.k 20 --steps-per-save 20"
)
CONFIG = "--load-config outputs/.../config.yml"
RUN = {  # In this order, each command in README.md with the flags to append.
    "beags sample": "--output my_scene --width 64 --height 48 --views 12",
    "beags doctor [--data X]": "--data my_scene",
    "beags masks make --data X --source NAME": "--options folder=masks --output made",
    "beags masks check --data X": "",
    "ns-train beags-fast --data my_scene": SHORT.replace("base-steps 60", "base-steps 200"),  # killed on its way
    "beags resume RUN": "",  # The killed training goes on.
    f"beags export {CONFIG} --all --format ply glb html": "--resolution 24 --output exported",
    "beags masks reproject --load-config C": "",
    "beags view outputs/...": "",  # It runs until its page is there.
    f"beags eval {CONFIG} --picture worst.png": "",
    f"beags extract {CONFIG} --object cup": "",
    f"beags render {CONFIG} --object cup --format before-after": "--size 48 --views 2",
    "ns-export gaussian-splat --load-config outputs/.../extracted/cup/config.yml --output-dir exports/": "",
    "beags demo [--data X]": "--data my_scene --downscale 2 --preset beags-tiny",
}
STARTED = ("beags sample", "beags resume RUN")
ELSEWHERE = {
    "ns-train <preset> --data X": "the two lines of ns-train are run",
    "beags export --load-config C --all [--format ply glb html]": "a line with --all is run",
    "beags eval --load-config C": "a line of it is run",
    "beags extract --load-config C [--object NAME ...] [--remove]": "a line of it is run",
    "beags render --load-config C [--object NAME ...]": "a line of it is run",
    "beags view RUN": "a line of it is run",
    "beags clean SCENE --data X": "refines a whole scene; test_clean_command.py runs it",
    "beags process --data PHOTOS_OR_VIDEO --output-dir X": "this scene has no texture; test_process.py runs it",
    "beags bench NAME": "trains for minutes; test_bench_running.py runs experiments to their tables",
    "beags masks weights": "fetches a file; test_salient_source.py runs it",
    "beags masks agree --load-config C": "test_mask_commands.py runs it",
    "make demo": "beags demo is run; what make calls is looked at below",
    "make demo DATA=walk.mp4": "the same",
    "make test": "runs these tests",
    "pip install .": "make setup has done it, editable, in the environment that runs this test",
}
OWN = {  # name in README.md: name here
    r" \[.*\]": "",
    r"outputs/\.\.\.": "{run}",
    r"RUN$": "{run}",
    r"--load-config C$": "--load-config {run}/config.yml",
    r"--data X": "--data my_scene",
    r"--source NAME": "--source id-images",
}


def commands() -> set[str]:
    """Return the commands in code blocks, without comments, and in the first column of tables."""
    blocks = [line.partition("  ")[0].partition(" #")[0].strip() for line in code_lines(README)]
    tables = re.findall(r"^\| `([^`]+)` \|", README, re.MULTILINE)
    return {line for line in (*blocks, *tables) if PROGRAM.match(line)}


def test_every_command_is_run_or_listed_with_a_reason():
    found = commands()
    assert len(found) > 25
    assert found == {*RUN, *ELSEWHERE}, "neither run nor listed, or no longer in these pages"
    assert not set(RUN) & set(ELSEWHERE) and all(ELSEWHERE.values())


def test_make_calls_the_commands():
    for line, recipe in (
        ("make demo", '/beags" demo'),
        ("make demo DATA=walk.mp4", '/beags" demo --data "walk.mp4"'),
        ("make soak", '/python" tests/soak/fuzz.py --count "1000" --seed "0"'),
    ):
        command = [*shlex.split(line), "--dry-run", "--no-print-directory"]  # "make test" is a make above this one
        dry = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
        assert any(recipe in line for line in dry.stdout.splitlines()), line


class Reader:
    """A user at a terminal in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {
            **os.environ, "PATH": f"{BIN}:{os.environ['PATH']}", "OMP_WAIT_POLICY": "PASSIVE", "COLUMNS": "200",
            "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]]),
        }  # fmt: skip

    @property
    def run(self) -> Path:
        """Return the run of ns-train that was begun last."""
        return max((path.parent for path in self.folder.glob("outputs/my_scene/beags-*/*/config.yml")), key=_changed)

    def words(self, line: str, more: str) -> list[str]:
        for name, own in OWN.items():
            if re.search(name, line):
                line = re.sub(name, own.replace("{run}", str(self.run)) if "{run}" in own else own, line)
        return shlex.split(f"{line} {more}")

    @contextmanager
    def started(self, line: str, more: str) -> Iterator[subprocess.Popen[bytes]]:
        """Start the program, which ends with this block at the latest."""
        command = bound(self.words(line, more), signal.SIGKILL)
        with open(self.folder / "log.txt", "w") as log:
            process = subprocess.Popen(
                command, cwd=self.folder, env=self.environment, stdout=log, stderr=subprocess.STDOUT
            )
        try:
            yield process
        finally:
            process.kill()
            process.wait()

    def does(self, line: str, more: str) -> None:
        if line.startswith("beags") and line not in STARTED:
            assert "Traceback" not in called(*self.words(line, more))
            return
        with self.started(line, more) as process:
            code = process.wait(600)
        text = (self.folder / "log.txt").read_text()
        assert code == 0 and "Traceback" not in text, f"{line}: exit code {code}\n{text[-3000:]}"

    def waits(self, process: subprocess.Popen[bytes], until) -> None:
        end = time.monotonic() + 600
        while not until():
            assert process.poll() is None and time.monotonic() < end, (self.folder / "log.txt").read_text()[-3000:]
            time.sleep(0.02)

    def trains_and_is_killed(self, line: str, more: str) -> None:
        """Kill the training after its first checkpoint."""
        with self.started(line, more) as process:
            self.waits(process, lambda: any(self.folder.glob("outputs/my_scene/*/*/nerfstudio_models/step-*.ckpt")))

    def views(self, line: str) -> None:
        port = free_port()
        with self.started(line, f"--port {port}") as process:
            self.waits(process, lambda: answers(port))
            process.terminate()
            process.wait(120)
        assert "Traceback" not in (self.folder / "log.txt").read_text()


def _changed(path: Path) -> float:
    return path.stat().st_mtime


def answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5) as page:
            return b"<html" in page.read()
    except OSError:
        return False


def test_the_commands_run_in_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *sys.path[1:]]))
    reader = Reader(tmp_path)
    for line, more in RUN.items():
        if line.startswith("ns-train beags-fast"):
            reader.trains_and_is_killed(line, more)
            assert not (reader.run / "training.json").exists()
        elif line.startswith("beags view"):
            reader.views(line)
        else:
            reader.does(line, more)
    (trained,) = tmp_path.glob("outputs/my_scene/beags-*/*/training.json")
    assert trained.parents[1].name == "beags-fast" and len(list((tmp_path / "exported").glob("*.ply"))) > 3
    run = reader.run
    for name in (
        "worst.png", "made/masks", "made/classes.json", "exported/manifest.json", "outputs/my_scene/summary.json",
        "outputs/my_scene/contact_sheet.png", "outputs/masks_check/my_scene/report.json",
        run / "extracted/cup/cup.ply", run / "reprojected/before_after.png",
    ):  # fmt: skip
        assert (tmp_path / name).exists(), name
    assert any((tmp_path / "exports").glob("*.ply")) and any((run / "renders").iterdir())
    assert len(list((tmp_path / "exported").glob("*.glb"))) >= 1
