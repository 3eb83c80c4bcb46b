"""The program that runs trials in processes of their own: ``python -m`` with this module reads a folder from each line.

A line has "trained" or "scored", how far to run the trial, and its folder, which holds trial.json. The worker trains
into FOLDER/run and writes FOLDER/trained.json, then measures and writes FOLDER/result.json. A failure writes
FOLDER/failed.json with the reason in a sentence. Saved work of an interrupted attempt is not repeated. The output goes
to FOLDER/log.txt. For each folder the program prints the exit code of the trial's process. This process is forked, so
that imports, which take longer than a short trial, happen once. If there may be a GPU, each process is a new start of
this program ("UNTIL FOLDER" as arguments): imports start CUDA, which cannot be used after a fork.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from beags_benchmarks.experiments.engines.trial_folder import INTERRUPTED, TRAINED, read_json
from beags_plugin.system.child_processes import end_with_parent
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig


GPU_FILES = ("/dev/nvidiactl", "/dev/dxg")
"""Files of the GPU drivers of Linux, and of Linux under Windows."""


def serve() -> None:
    """Read folders from standard input until it ends."""
    with_gpu = any(os.path.exists(path) for path in GPU_FILES)
    if not with_gpu:
        _import_everything()
    for line in sys.stdin:
        until, _, folder = line.rstrip("\n").partition(" ")
        print(_in_program(folder, until) if with_gpu else _forked(folder, until), flush=True)


def _in_program(folder: str, until: str) -> int:
    """Run the trial in ``folder`` in a new start of this program; returns the exit code, negative for a signal."""
    command = [sys.executable, "-m", "beags_benchmarks.experiments.worker", until, folder]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL).wait()


def _forked(folder: str, until: str) -> int:
    """Run the trial in ``folder`` in a fork of this process; returns the exit code, negative for a signal."""
    child = os.fork()
    if child == 0:
        os._exit(_in_child(Path(folder), until))
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def _import_everything() -> None:
    """Import what a trial needs without computing anything: threads do not survive the fork."""
    from nerfstudio.scripts import train  # noqa: F401

    from beags_benchmarks.experiments import measure  # noqa: F401
    from beags_plugin.objects import evaluate, extract  # noqa: F401
    from beags_plugin.ops import extension
    from beags_plugin.plugin import presets  # noqa: F401

    extension.load()


def _in_child(folder: Path, until: str) -> int:
    """Run the trial in ``folder`` with its output in a file; returns the exit code."""
    end_with_parent()  # the parent is the program that waits for the trial
    code = 1
    try:
        with open(folder / "log.txt", "ab") as log, open(os.devnull) as nothing:
            os.dup2(nothing.fileno(), 0)
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        code = _trial(folder, until)
    except KeyboardInterrupt:  # the training has saved its state
        code = INTERRUPTED
    except BaseException:  # no error may continue in the loop of the parent
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return code


def _trial(folder: Path, until: str) -> int:
    """Run ``folder/trial.json`` and write its result; returns the exit code."""
    request = json.loads((folder / "trial.json").read_text())
    try:
        trained = read_json(folder / "trained.json")
        if trained is None:
            trained = train_trial(request, folder / "run")
            if request["base"] is not None:
                write_text_atomically(json.dumps(trained, indent=1), folder / "trained.json")
        if request["base"] is None:
            name, content = "result", trained
        elif until == TRAINED:
            return 0
        else:
            from beags_benchmarks.experiments.measure import measure_run

            name, content = "result", {**trained, **measure_run(folder / "run" / "config.yml")}
    except UserError as error:
        name, content = "failed", {"failed": str(error)}
    except Exception as error:  # any error becomes a row of the table, and the other trials run
        traceback.print_exc()
        name, content = "failed", {"failed": f"{type(error).__name__}: {error}".splitlines()[0]}
    write_text_atomically(json.dumps(content, indent=1), folder / f"{name}.json")
    return int(name == "failed")


def train_trial(request: dict[str, Any], run_folder: Path) -> dict[str, Any]:
    """Train, or continue an interrupted training.

    Returns {"steps", "gaussians", "seconds": {stage: s}, "cpu_seconds", "peak_memory_mb", "own_memory_mb" (the peak
    without the loaded program), "processor"}. cpu_seconds is None after an interruption, as the share of the killed
    process is unknown. A refinement adds "summary" (a line for each stage), "voxel_size" and "training_pixels"; some
    refiners add a figure of their own, such as "labelled_share".
    """
    from beags_plugin.data.files import image_size
    from beags_plugin.plugin.launch import resume, train
    from beags_plugin.refiners import make_refiner
    from beags_plugin.runs.checkpoint_file import read_checkpoint
    from beags_plugin.runs.layout import REPORT_FILE, newest_checkpoint
    from beags_plugin.runs.prepared import read_grid
    from beags_plugin.system.memory import peak_memory_mb

    start_memory_mb = peak_memory_mb()
    config = trial_config(request, run_folder)
    model = config.model_config
    again = any(config.get_checkpoint_dir().glob("step-*.ckpt"))
    if not again:
        train(config)
    elif not (run_folder / REPORT_FILE).exists():
        resume(run_folder)
    # CPU time does not depend on other programs.
    result: dict[str, Any] = {"cpu_seconds": None if again else time.process_time(), "processor": _processor(config)}
    result |= json.loads((run_folder / REPORT_FILE).read_text())
    result["own_memory_mb"] = result["peak_memory_mb"] - start_memory_mb
    checkpoint = read_checkpoint(newest_checkpoint(config.get_checkpoint_dir()))
    result["gaussians"] = len(checkpoint["pipeline"]["_model.class_ids"])
    idle = make_refiner(model.refiner, model.refiner_options).leaves_base
    refined = 0 if idle else int(checkpoint["pipeline"]["_model.refined_steps"])
    result["steps"] = model.base_steps + refined
    if model.refine_steps == 0:
        return result
    del result["seconds"]["base training"]  # this is the time of loading one
    prepared = run_folder / "prepared"
    result["summary"] = json.loads((prepared / "report.json").read_text())["summary"]
    grid = read_grid(prepared / "grid.pt")
    result["voxel_size"] = None if grid is None else float(grid.voxel_size)
    sizes = [image_size(path) for path in (prepared / "masks").rglob("*.png")]
    result["training_pixels"] = sum(width * height for width, height in sizes)
    return result


def _processor(config: BeagsTrainerConfig) -> str:
    """Return the name of the processor that computed, since processors round differently."""
    import torch

    from beags_benchmarks.provenance import describe_machine

    on_gpu = config.machine.device_type == "cuda" and torch.cuda.is_available()
    return torch.cuda.get_device_name() if on_gpu else str(describe_machine()["cpu"])


def trial_config(request: dict[str, Any], run_folder: Path) -> BeagsTrainerConfig:
    """Return the preset's config with the trial's overrides, data and seed."""
    from beags_benchmarks.experiments.scenes import parser_options
    from beags_plugin.plugin.presets import preset_config

    config = preset_config(request["preset"], request["overrides"], Path("trial.json"))
    config.run_dir = run_folder
    config.vis = "tensorboard"
    config.steps_per_eval_image = 0  # held-out views are scored at the end
    config.machine.seed = request["seed"]
    data = config.data_config
    data.train_cameras_sampling_seed = request["seed"]
    parser = cast("BeagsDataParserConfig", data.dataparser)
    parser.data = Path(request["data"])
    for name, value in parser_options(request.get("options", {})).items():
        setattr(parser, name, value)
    parser.downscale_factor = (parser.downscale_factor or 1.0) * request[
        "downscale"
    ]  # a variant may shrink the images further
    if request["masks"] is not None:
        parser.masks_path = Path(request["masks"])
        if (
            names := parser.masks_path / "classes.json"
        ).exists():  # names of other objects, for which there is no truth
            parser.classes_path, parser.ground_truth_path = names, parser.masks_path / "no_truth"
    if request["base"] is not None:
        config.load_dir = Path(request["base"]) / "nerfstudio_models"
    return config


if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit(_in_child(Path(sys.argv[2]), sys.argv[1]))
    serve()
