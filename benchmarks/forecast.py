"""What a run is said to need before it begins, against what it takes: memory, and disk in its folder and in TMPDIR.

    python -m benchmarks.forecast --json forecast.json

Trains beags-tiny for a few steps on samples of several sizes, each in a process of its own (Linux). Memory is the
kernel's high-water mark; disk is asked many times a second, files without a name too. The forecast is the one of
``beags doctor --data`` with the number of Gaussians that the run came to; what it says without that is in the JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from beags_plugin.bench.provenance import commit, describe_machine
from beags_plugin.system.child_processes import bound

SIZES = ((12, 96, 72), (30, 192, 144), (40, 320, 240), (16, 800, 600))  # training views, width, height
PRESET = "beags-tiny"
OPTIONS = {
    "pipeline.model.base_steps": 300, "pipeline.model.refine_steps": 20, "pipeline.model.densify.start": 50,
    "pipeline.model.densify.every": 50, "pipeline.model.densify.stop": 250,
}  # fmt: skip


def main() -> None:
    """Parse arguments, run, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=range(len(SIZES)), help="which of them, from 0")
    parser.add_argument("--json", type=Path, default=None)
    arguments = parser.parse_args()
    rows = []
    for views, width, height in (SIZES[index] for index in arguments.sizes):
        with tempfile.TemporaryDirectory(prefix="beags-forecast-") as folder:
            rows.append(measured(Path(folder), views, width, height))
        print(line(rows[-1]), flush=True)
        if arguments.json:
            report = {"preset": PRESET, "options": OPTIONS, "commit": commit(), "machine": describe_machine()}
            arguments.json.write_text(json.dumps({**report, "rows": rows}, indent=1))


def line(row: dict) -> str:
    """A row of the table in docs/robustness.md: forecast / measured."""
    cells = [f"{row['views']} x {row['width']}x{row['height']}", f"{row['gaussians']:,}"]
    for name in ("memory", "folder", "temporary"):
        told, found = row[f"forecast_{name}_mb"], row[f"measured_{name}_mb"]
        cells.append(f"{told:,.1f} / {found:,.1f} = {told / max(found, 1e-9):.2f}")
    return f"| {' | '.join(cells)} |"


def measured(folder: Path, views: int, width: int, height: int) -> dict:
    """Forecast and peaks of one run."""
    from beags_plugin.plugin.presets import preset_config
    from beags_plugin.plugin.training.memory_guard import forecast_of_data
    from beags_plugin.sample.writer import SampleConfig, write_sample

    data, run, temporary = folder / "data", folder / "run", folder / "tmp"
    write_sample(data, SampleConfig(seed=3, width=width, height=height, num_train=views, num_test=4, antialias=1))
    temporary.mkdir()
    config = preset_config(PRESET, OPTIONS, Path("benchmark"))
    found = forecast_of_data(config, data)
    words = [f"--{name.replace('_', '-')}={value}" for name, value in OPTIONS.items()]
    command = [Path(sys.executable).parent / "ns-train", PRESET, "--data", data, "--run-dir", run, *words]
    peaks = {"folder": 0.0, "temporary": 0.0}
    with open(folder / "log.txt", "wb") as log:
        process = subprocess.Popen(
            bound([*command, "--vis", "tensorboard"], signal.SIGKILL), stdout=log, stderr=log,
            env={**os.environ, "TMPDIR": str(temporary)},
        )  # fmt: skip
        while process.poll() is None:
            peaks["folder"] = max(peaks["folder"], size_below(run))
            peaks["temporary"] = max(peaks["temporary"], size_below(temporary) + unnamed_size(process.pid, temporary))
            time.sleep(0.01)
    if process.returncode != 0:
        raise RuntimeError(f"the training failed: {(folder / 'log.txt').read_text()[-3000:]}")
    count = gaussians(run)
    exact = replace(found, grown=count, split=1.0)
    return {
        "views": views, "width": width, "height": height, "gaussians": count, "gaussians_at_most": found.surfels,
        "forecast_memory_mb": exact.peak, "forecast_memory_at_most_mb": found.peak,
        "measured_memory_mb": json.loads((run / "training.json").read_text())["peak_memory_mb"],
        "forecast_folder_mb": exact.disk, "measured_folder_mb": peaks["folder"],
        "forecast_temporary_mb": exact.temporary, "measured_temporary_mb": peaks["temporary"],
    }  # fmt: skip


def gaussians(run: Path) -> int:
    """How many a run has come to."""
    import torch

    (checkpoint,) = (run / "nerfstudio_models").glob("*.ckpt")
    return len(torch.load(checkpoint, weights_only=True)["pipeline"]["_model.gauss_params.means"])


def size_below(folder: Path) -> float:
    """MB (10^6 bytes) of the files in a folder and below."""
    total = 0
    for place, _, names in os.walk(folder):  # which passes over folders that go meanwhile
        for name in names:
            with suppress(OSError):
                total += os.stat(os.path.join(place, name)).st_size
    return total / 1e6


def unnamed_size(pid: int, folder: Path) -> float:
    """MB of the files that a process has open in a folder where they no longer have a name."""
    total = 0
    for path in Path(f"/proc/{pid}/fd").glob("*"):
        with suppress(OSError):
            target = os.readlink(path)
            if target.startswith(str(folder)) and target.endswith("(deleted)"):
                total += path.stat().st_size
    return total / 1e6


if __name__ == "__main__":
    main()
