"""The timing of commands: which object it exports, and the memory that it reports."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from run_folders import rename_classes, write_scene, write_trained

from beags_benchmarks.provenance import with_these_packages
from beags_benchmarks.studies.answers import first_object

pytest.importorskip("nerfstudio")

MEASURED = """
import sys
from pathlib import Path
from beags_benchmarks.studies.answers import answer
print(answer("", [Path(sys.executable).name, "-c", "bytearray(b'1') * 200_000_000"]).memory)
"""


def test_the_object_is_the_first_one_of_the_run(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    rename_classes(config, {0: "background", 1: "mug", 2: "vase"})
    assert first_object(config.parent) == first_object(config) == "mug"


def test_a_run_without_objects_is_named(tmp_path):
    with pytest.raises(SystemExit, match="name one with --object"):
        first_object(tmp_path)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems count memory in other units")
def test_the_memory_is_the_peak_of_the_command():
    done = subprocess.run(
        [sys.executable, "-c", MEASURED],
        capture_output=True,
        text=True,
        check=True,
        env=with_these_packages(os.environ),
    )
    assert 200 < float(done.stdout) < 300
