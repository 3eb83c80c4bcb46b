"""Trials, each in a process of its own: ``python -m beags_plugin.bench.worker`` reads their folders, a line each.

A trial's folder holds trial.json. The worker trains into FOLDER/run, measures, and writes FOLDER/result.json; or
FOLDER/failed.json with the reason in a sentence. What it prints goes to FOLDER/log.txt. For each folder the program
prints the exit code of the process that it forked: imports, which take longer than a short trial, are done once.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from beags_plugin.system.child_processes import end_with_parent
from beags_plugin.system.errors import UserError

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig


def serve() -> None:
    """Read folders from standard input until it ends."""
    _import_everything()
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            os._exit(_in_child(Path(line.rstrip("\n"))))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def _import_everything() -> None:
    """Import what a trial needs, but compute nothing: threads would not survive the fork."""
    from nerfstudio.scripts import train  # noqa: F401

    from beags_plugin.bench import measure  # noqa: F401
    from beags_plugin.ops import extension
    from beags_plugin.plugin import presets  # noqa: F401
    from beags_plugin.plugin.objects import (
        evaluate,  # noqa: F401
        extract,  # noqa: F401
    )

    extension.load()


def _in_child(folder: Path) -> int:
    """The exit code of the trial in ``folder``."""
    end_with_parent()  # the program that waits for the trial
    code = 1
    try:
        with open(folder / "log.txt", "wb") as log, open(os.devnull) as nothing:
            os.dup2(nothing.fileno(), 0)
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        code = main(folder)
    except BaseException:  # an interrupt too must not go on in the loop of the parent
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return code


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

    {"steps", "gaussians", "seconds": {stage: s}, "cpu_seconds", "peak_memory_mb", "own_memory_mb" (of the peak, what
    the loaded program does not take)}; of a refinement also what
    ``measure.measure_run`` gives, "summary" (a line per stage), "voxel_size" and "training_pixels".
    """
    from beags_plugin.plugin.runs.launch import train
    from beags_plugin.system.memory import peak_memory_mb

    start_memory_mb = peak_memory_mb()
    config = trial_config(request, run_folder)
    model = config.model_config
    train(config)
    result = {"steps": model.base_steps + model.refine_steps, "cpu_seconds": _cpu_seconds()}
    result |= json.loads((run_folder / "training.json").read_text())
    result["own_memory_mb"] = result["peak_memory_mb"] - start_memory_mb
    if model.refine_steps == 0:
        return {**result, "gaussians": _gaussians(config)}
    from beags_plugin.bench.measure import measure_run

    del result["seconds"]["base training"]  # that of loading one
    prepared = run_folder / "prepared"
    result["gaussians"] = _gaussians(config)
    result["summary"] = json.loads((prepared / "report.json").read_text())["summary"]
    result["voxel_size"] = _voxel_size(prepared / "grid.pt")
    result["training_pixels"] = _pixels(prepared / "masks")
    return {**result, **measure_run(run_folder / "config.yml")}


def trial_config(request: dict[str, Any], run_folder: Path) -> BeagsTrainerConfig:
    """The preset's config with the trial's overrides, data and seed."""
    from beags_plugin.plugin.presets import preset_config

    config = preset_config(request["preset"], request["overrides"], Path("trial.json"))
    config.run_dir = run_folder
    config.vis = "tensorboard"
    config.steps_per_eval_image = 0  # held-out views are for the end
    config.machine.seed = request["seed"]
    data = config.data_config
    data.train_cameras_sampling_seed = request["seed"]
    parser = cast("BeagsDataParserConfig", data.dataparser)
    parser.data = Path(request["data"])
    parser.downscale_factor *= request["downscale"]  # a variant may shrink the images further
    if request["masks"] is not None:
        parser.masks_path = Path(request["masks"])
    if request["base"] is not None:
        config.load_dir = Path(request["base"]) / "nerfstudio_models"
    return config


def _gaussians(config: BeagsTrainerConfig) -> int:
    from beags_plugin.plugin.runs.checkpoint_file import read_checkpoint
    from beags_plugin.plugin.runs.layout import newest_checkpoint

    checkpoint = read_checkpoint(newest_checkpoint(config.get_checkpoint_dir()))
    return len(checkpoint["pipeline"]["_model.class_ids"])


def _voxel_size(grid: Path) -> float | None:
    from beags_plugin.plugin.runs.prepared import grid_state

    state = grid_state(grid)
    return float(state["voxel_size"]) if state else None


def _pixels(masks: Path) -> int:
    """Of all training views."""
    from beags_plugin.data.files import image_size

    sizes = [image_size(path) for path in masks.rglob("*.png")]
    return sum(width * height for width, height in sizes)


def _cpu_seconds() -> float:
    """Of this process so far: it does not grow while other programs have the cores."""
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
    serve()
