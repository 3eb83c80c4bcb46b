"""What a training of ``beags demo`` prints into a file: a few rows, and no warnings for the authors of libraries."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
from places import ROOT

from beags_plugin.commands import demo_training
from beags_plugin.commands.demo import PRESET, PRESET_OF_PHOTOS
from beags_plugin.commands.scene_setup import MadeScene
from beags_plugin.plugin.presets import load_preset

WARNINGS = """
import warnings
from beags_plugin.system.errors import silence_libraries
silence_libraries()
for kind, module in ((FutureWarning, "torch.jit"), (UserWarning, "nerfstudio.utils.writer"), (UserWarning, "mine")):
    warnings.warn_explicit(module, kind, "file.py", 1, module=module)
"""


def started(monkeypatch, tmp_path, terminal: bool, preset: str = "beags-fast") -> list[str]:
    """Return the command of a training."""
    commands: list[list[str]] = []
    monkeypatch.setattr(demo_training, "finish", commands.append)
    monkeypatch.setattr(demo_training.sys, "stdout", SimpleNamespace(isatty=lambda: terminal, write=len, flush=int))
    demo_training.train(MadeScene(tmp_path / "data"), tmp_path / "run", preset, 1.0, "all")
    return commands[0]


@pytest.mark.parametrize("preset", [PRESET, PRESET_OF_PHOTOS])
def test_a_file_gets_about_ten_rows_each_once(tmp_path, monkeypatch, preset):
    words = started(monkeypatch, tmp_path, terminal=False, preset=preset)
    model: Any = load_preset(preset).config.pipeline.model
    rows = (model.base_steps + model.refine_steps) / int(words[words.index("--logging.steps-per-log") + 1])
    assert 8 <= rows <= 20
    # A table of the last rows would be printed anew at each row.
    assert words[words.index("--logging.local-writer.max-log-size") + 1] == "0"


def test_a_terminal_gets_nerfstudios_table(tmp_path, monkeypatch):
    assert not any(word.startswith("--logging") for word in started(monkeypatch, tmp_path, terminal=True))


@pytest.mark.parametrize(
    ("chosen", "shown"),
    [(None, ["mine"]), ("default", ["torch.jit", "nerfstudio.utils.writer", "mine"]), ("ignore", [])],
)
def test_warnings_of_libraries_are_shown_only_to_those_who_ask(monkeypatch, chosen, shown):
    monkeypatch.delenv("PYTHONWARNINGS", raising=False)
    if chosen is not None:
        monkeypatch.setenv("PYTHONWARNINGS", chosen)
    environment = {**demo_training.quiet_environment(), "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path[1:]])}
    done = subprocess.run([sys.executable, "-c", WARNINGS], capture_output=True, text=True, env=environment, timeout=60)
    assert [module for module in ("torch.jit", "nerfstudio.utils.writer", "mine") if module in done.stderr] == shown


def test_future_warnings_before_the_plugin_starts_are_hidden(monkeypatch):
    monkeypatch.delenv("PYTHONWARNINGS", raising=False)
    done = subprocess.run(
        [sys.executable, "-c", "import warnings; warnings.warn('torch', FutureWarning)"],
        capture_output=True, text=True, env=demo_training.quiet_environment(), timeout=60,
    )  # fmt: skip
    assert done.stderr == ""
