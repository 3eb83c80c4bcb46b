"""One trial in a process of its own: ``python -m beags_plugin.bench.worker FOLDER``, with FOLDER/trial.json.

Trains into FOLDER/run, measures, and writes FOLDER/result.json; or FOLDER/failed.json with the reason in a sentence.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.errors import UserError

if TYPE_CHECKING:
    from beags_plugin.plugin.config import BeagsTrainerConfig


def main(folder: Path) -> int:
    """Do what ``folder/trial.json`` asks for; returns the exit code."""
    request = json.loads((folder / "trial.json").read_text())
    try:
        result = run(request, folder / "run")
    except UserError as error:
        return _failed(folder, str(error))
    except Exception as error:  # whatever goes wrong is a row of the table, and the other trials go on
        traceback.print_exc()
        return _failed(folder, f"{type(error).__name__}: {error}".splitlines()[0])
    _write(folder / "result.json", result)
    return 0


def run(request: dict[str, Any], run_folder: Path) -> dict[str, Any]:
    """Train and measure.

    {"steps", "gaussians", "seconds": {stage: s}, "cpu_seconds", "peak_memory_mb"}; of a refinement also what
    ``measure.measure_run`` gives, "findings" (a line per stage), "voxel_size" and "training_pixels".
    """
    from beags_plugin.plugin.launch import train

    config = trial_config(request, run_folder)
    model = config.model_config
    train(config)
    cpu_seconds = _cpu_seconds()
    training = json.loads((run_folder / "training.json").read_text())
    steps = model.base_steps + model.refine_steps
    result = {"steps": steps, "cpu_seconds": cpu_seconds, **training}
    if model.refine_steps == 0:
        return {**result, "gaussians": _gaussians(config)}
    from beags_plugin.bench.measure import measure_run

    del result["seconds"]["base training"]  # that of loading one
    prepared = run_folder / "prepared"
    result["findings"] = json.loads((prepared / "report.json").read_text())["findings"]
    result["voxel_size"] = _voxel_size(prepared / "grid.pt")
    result["training_pixels"] = _pixels(prepared / "masks")
    return {**result, **measure_run(run_folder / "config.yml")}


def trial_config(request: dict[str, Any], run_folder: Path) -> BeagsTrainerConfig:
    """The preset's config with the trial's overrides, data and seed."""
    from beags_plugin.plugin.presets import load_preset, override

    config = load_preset(request["preset"]).config
    config.run_dir = run_folder
    config.vis = "tensorboard"
    config.steps_per_eval_image = 0  # held-out views are for the end
    config.machine.seed = request["seed"]
    data = config.data_config
    data.train_cameras_sampling_seed = request["seed"]
    data.dataparser.data = Path(request["data"])
    data.dataparser.downscale_factor = request["downscale"]
    if request["masks"] is not None:
        data.dataparser.masks_path = Path(request["masks"])
    if request["base"] is not None:
        config.load_dir = Path(request["base"]) / "nerfstudio_models"
    for key, value in request["overrides"].items():
        override(config, key, value, Path("trial.json"))
    return config


def _gaussians(config: BeagsTrainerConfig) -> int:
    import torch

    from beags_plugin.plugin.runs import newest_checkpoint

    checkpoint = torch.load(newest_checkpoint(config.get_checkpoint_dir()), map_location="cpu", weights_only=True)
    return len(checkpoint["pipeline"]["_model.class_ids"])


def _voxel_size(grid: Path) -> float | None:
    import torch

    state = torch.load(grid, weights_only=True)
    return float(state["voxel_size"]) if state else None


def _pixels(masks: Path) -> int:
    """Of all training views."""
    from beags_plugin.plugin.layout import image_size

    sizes = [image_size(path) for path in masks.rglob("*.png")]
    return sum(width * height for width, height in sizes)


def _cpu_seconds() -> float:
    """Of this process so far, start and loading included: it does not grow while other programs have the cores."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _failed(folder: Path, reason: str) -> int:
    _write(folder / "failed.json", {"failed": reason})
    return 1


def _write(path: Path, content: dict[str, Any]) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(content, indent=1))
    os.replace(part, path)  # there is no half of a result


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
