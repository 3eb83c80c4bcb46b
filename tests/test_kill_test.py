"""The kill test notices runs that differ, and kills a process in the write that it chose."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import pytest
import torch

from beags_plugin.system import whole_files

if sys.platform != "linux":
    pytest.skip("processes are forked, and looked at in /proc", allow_module_level=True)

sys.path.insert(0, str(Path(__file__).parent.parent / "scripts"))
import forked
import same_bits


def write_run(folder: Path, value: float = 1.0, seconds: float = 3.0) -> Path:
    """What stands for a complete run."""
    for name in ("nerfstudio_models/step-000000009.ckpt", "base/nerfstudio_models/step-000000004.ckpt"):
        (folder / name).parent.mkdir(parents=True)
        torch.save({"a": [torch.tensor([value, torch.nan])], "seconds": seconds}, folder / name)
    (folder / "prepared/masks").mkdir(parents=True)
    torch.save({"keys": torch.arange(3)}, folder / "prepared/grid.pt")
    (folder / "prepared/masks/a.png").write_bytes(b"picture")
    (folder / "held_out.json").write_text(json.dumps([{"psnr": value, "seconds": seconds}]))
    return folder


def test_runs_are_the_same_but_for_clocks(tmp_path):
    one = write_run(tmp_path / "one")
    assert same_bits.run_differences(one, write_run(tmp_path / "other", seconds=4.0)) == []
    other = write_run(tmp_path / "third", value=1.0000001)
    (other / "prepared/masks/a.png").unlink()
    found = same_bits.run_differences(one, other)
    assert len(found) == 4 and "only in one: prepared/masks/a.png" in found  # two tensors and the curve besides


@pytest.mark.parametrize("share, part", [(0.5, 500), (1.1, 1000)])
def test_a_process_ends_in_the_write_that_is_chosen(tmp_path, share, part):
    def write() -> None:
        with forked.killed_in_write(".ckpt", 2, share):
            for name in ("one.ckpt", "between.json", "two.ckpt", "three.ckpt"):
                whole_files.write_whole(tmp_path / name, lambda file: [file.write(bytes(100)) for _ in range(10)])

    assert forked.run(write, tmp_path / "log") == -signal.SIGKILL
    there = {path.name: path.stat().st_size for path in tmp_path.iterdir() if path.name != "log"}
    assert there == {"one.ckpt": 1000, "between.json": 1000, ".two.ckpt.part": part}
