"""Runs of an older format are refused in one sentence; importing the plugin changes nothing for other methods."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from run_folders import write_scene, write_trained

from beags_plugin.options.run_format import RUN_FORMAT
from beags_plugin.plugin.options.saved_config import load_run_config
from beags_plugin.system.errors import UserError

REFUSED = "was written by an older version of beags: train again, or use the version that wrote it."


def first_format(text: str) -> str:
    """Return a config.yml as the first format wrote it: other modules, no version."""
    text = text.replace("beags_plugin.plugin.options.config.", "beags_plugin.plugin.config.")
    return without_version(text.replace("beags_plugin.plugin.views.", "beags_plugin.plugin."))


def without_version(text: str) -> str:
    assert f"\nrun_format: {RUN_FORMAT}\n" in text
    return text.replace(f"\nrun_format: {RUN_FORMAT}\n", "\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("runs")
    return write_trained(root / "run", write_scene(root / "data"))


@pytest.mark.parametrize("older", [first_format, without_version])
def test_an_older_run_is_refused_in_one_sentence(run, tmp_path, older):
    path = tmp_path / "config.yml"
    path.write_text(older(run.read_text("utf8")), "utf8")
    with pytest.raises(UserError) as refused:
        load_run_config(path)
    assert str(refused.value) == f"{path} {REFUSED}"


def test_a_newer_run_is_refused_too(run, tmp_path):
    path = tmp_path / "config.yml"
    path.write_text(run.read_text("utf8").replace(f"run_format: {RUN_FORMAT}", "run_format: 99"), "utf8")
    with pytest.raises(UserError, match="by a newer version of beags"):
        load_run_config(path)


def ns_eval(config: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "nerfstudio.scripts.eval", "--load-config", str(config)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.parametrize("older", [first_format, without_version])
@pytest.mark.slow("starts nerfstudio's programs, which import for seconds")
def test_programs_of_nerfstudio_say_the_same_of_an_older_run(run, tmp_path, older):
    path = tmp_path / "config.yml"
    path.write_text(older(run.read_text("utf8")), "utf8")
    done = ns_eval(path)
    assert done.returncode == 2 and done.stderr.strip().splitlines()[-1] == f"beags: this run {REFUSED}"
    assert "Traceback" not in done.stderr


@pytest.mark.slow("starts nerfstudio's programs, which import for seconds")
def test_programs_of_nerfstudio_print_one_sentence_for_bad_data(run, tmp_path):
    path = write_trained(tmp_path / "run", write_scene(tmp_path / "data"))
    (tmp_path / "data/transforms.json").write_text("{")
    done = ns_eval(path)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith(f"beags: {tmp_path}/data/transforms.json")


IMPORT = """
import sys, threading
hooks = sys.excepthook, threading.excepthook
import nerfstudio.configs.method_configs
from nerfstudio.configs.base_config import ViewerConfig
assert "beags_plugin.plugin.methods" in sys.modules, "the entry points of this package are not installed"
assert (sys.excepthook, threading.excepthook) == hooks
assert ViewerConfig().websocket_host == ViewerConfig.websocket_host == "0.0.0.0"
"""


@pytest.mark.slow("starts nerfstudio's programs, which import for seconds")
def test_other_methods_are_left_as_they_are():
    done = subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
