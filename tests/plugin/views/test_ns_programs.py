"""nerfstudio's programs on a run of ours: what they say before they have imported nerfstudio's methods."""

from __future__ import annotations

import shlex
import subprocess
import sys
import warnings

import pytest

pytest.importorskip("nerfstudio")

from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.plugin.views.ns_programs import prepare_reading


@pytest.fixture
def config(tmp_path):
    """Return the config.yml of a run of ours, as far as these programs read it; spaces are in its path."""
    path = tmp_path / "my run/config.yml"
    path.parent.mkdir()
    path.write_text("!!python/object:beags_plugin.plugin.options.config.BeagsTrainerConfig\n")
    return path


def said(monkeypatch, capsys, *words: object) -> str | None:
    """Return what a program prints before it ends with exit code 2; None if it goes on."""
    monkeypatch.setattr(sys, "argv", [str(word) for word in words])
    with warnings.catch_warnings():
        try:
            prepare_reading()
        except SystemExit as end:
            assert end.code == 2
            return capsys.readouterr().err
    return None


def test_without_ffmpeg_ns_render_names_a_command_that_needs_none(config, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", str(tmp_path))
    words = ("ns-render", "camera-path", "--load-config", config, "--camera-path-filename", "my path.json")
    sentence = said(monkeypatch, capsys, *words, "--output_path=a b.mp4")
    assert sentence is not None and "needs ffmpeg" in sentence
    assert shlex.split(sentence.partition("none: ")[2]) == [
        "beags", "render", "--load-config", str(config), "--camera-path", "my path.json", "--output", "a b.mp4"
    ]  # fmt: skip
    assert "turns about the objects" in str(said(monkeypatch, capsys, "ns-render", "interpolate", *words[2:4]))
    assert said(monkeypatch, capsys, "ns-render", "dataset", *words[2:4]) is None  # it writes images alone
    assert said(monkeypatch, capsys, "ns-viewer", *words[2:4]) is None
    (tmp_path / "ffmpeg").touch(0o755)
    assert said(monkeypatch, capsys, *words) is None


def test_ns_render_spiral_is_refused_for_runs_of_ours_alone(config, monkeypatch, capsys):
    """nerfstudio asserts that the data manager samples rays."""
    words = ("ns-render", "spiral", "--load-config", config)
    assert "--turn 60" in str(said(monkeypatch, capsys, *words))
    config.write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig\n")
    assert said(monkeypatch, capsys, *words) is None


PROGRAM = """
import sys, warnings
sys.argv = ["ns-viewer", "--load-config", {path!r}]
from beags_plugin.plugin.views.ns_programs import prepare_reading
prepare_reading()
for module in ("nerfstudio.field_components.activations", "torch.jit._script", "mine"):
    warnings.warn_explicit(f"of {{module}}", FutureWarning, "file.py", 1, module)
"""


@pytest.mark.parametrize("asked", [(), ("-W", "default")])
def test_warnings_of_libraries_are_silent_unless_asked_for_and_others_are_not(config, asked):
    program = PROGRAM.format(path=str(config))
    shown = subprocess.run([sys.executable, *asked, "-c", program], capture_output=True, text=True, check=True).stderr
    assert "of mine" in shown
    assert ("of nerfstudio" in shown, "of torch" in shown) == (bool(asked), bool(asked))


def test_ns_viewer_keeps_camera_paths_in_the_run(config, monkeypatch):
    """The folder of the photos may be somebody else's, or read-only."""
    monkeypatch.setattr(sys, "argv", ["ns-viewer", "--load-config", str(config)])
    manager = BeagsDataManager.__new__(BeagsDataManager)
    assert manager.get_datapath() == config.parent
