"""How much memory and disk a run on a CPU will need, told before it is begun, and whether that is there."""

from __future__ import annotations

import errno
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from beags_plugin.commands.doctor.check import Check
from beags_plugin.preparation.consistent_masks import AUTO, PAIRWISE_PIXELS
from beags_plugin.system.errors import UserError
from beags_plugin.system.memory import available_mb, memory_mb

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

STEP_MB = 160.0
"""What the first step takes whatever it draws: threads' stacks, libraries that load late."""
BYTES_OF_PIXEL = 200.0
"""Of the view that is drawn: its images, their gradients and what the backward keeps."""
SURFEL_SCRATCH = 150.0
"""Bytes of a surfel beside its parameters: its projection and its places in the lists of tiles."""
PROGRAM_MB = 600.0
"""What ns-train holds before it has read any data."""
PREPARATION_MB, PREPARATION_BYTES_OF_PIXEL = 500.0, 16.0
"""What the stages between base and refinement take at most, as depth and votes stream from disk; few pixels of all
views take less: so many bytes of each."""
PAIRWISE_BYTES_OF_PIXEL = 5.0
"""Of all views besides, where every view is projected into every other: depth and masks."""
GROWTH_OF_SPLIT = 1.6
"""How many Gaussians there are for each after a round of splitting at the borders of the masks, at most as measured."""
RUN_MB = 2.0
"""A run's config, curves and pictures on disk."""
PREPARED_BYTES_OF_PIXEL, DEPTH_BYTES_OF_PIXEL = 1.0, 4.0
"""Of the pixels of all views: in each round masks with their confidence, on disk; depth, in temporary files."""
TEMPORARY_BYTES_OF_PIXEL = 8.0
"""In the folder of temporary files: what all views show, or votes that are counted slab by slab."""
LEAST_FREE_MB = 200.0
"""A training that leaves the machine less stops, while it still can save."""


SMALLER = (
    "train with smaller photos (end the command with beags-data --downscale-factor 2), or bound the Gaussians "
    "(--pipeline.model.densify.pixels-per-surfel 100)"
)


NO_MEMORY = f"memory ran out before the first step: close other programs, or {SMALLER}."


@dataclass(frozen=True)
class Forecast:
    """What a run needs, MB of 10^6 bytes.

    program: what this process holds already. views: photos kept in memory. drawing: of one step, and
    preparation: of the stages after the base, but for the surfels. seeds: surfels to start from. grown: to how many
    they grow at most; None where nothing bounds them. split: how many there are then for each, where those at borders
    are split. bytes_of_surfel: in memory. available: what memory there is beside the
    program; None where the system does not tell.
    run_disk: of the run's folder, but for the surfels; disk_bytes_of_surfel: there. temporary: in the folder of
    temporary files. free_disk, free_temporary: on the disks of both, which may be one (one_disk).
    """

    program: float
    views: float
    drawing: float
    preparation: float
    seeds: int
    grown: int | None
    split: float
    bytes_of_surfel: float
    available: float | None
    run_disk: float
    disk_bytes_of_surfel: float
    temporary: float
    free_disk: float
    free_temporary: float
    one_disk: bool

    @property
    def surfels(self) -> int | None:
        """How many there are at most; None where nothing bounds them."""
        return None if self.grown is None else int(self.grown * self.split)

    @property
    def peak(self) -> float:
        """Largest memory of the process; without surfels where nothing bounds them."""
        own = (self.surfels or 0) * self.bytes_of_surfel / 1e6
        return self.program + self.views + max(self.drawing, self.preparation) + own

    @property
    def room(self) -> int | None:
        """How many surfels there is memory for; None where the system does not tell."""
        if self.available is None:
            return None
        rest = self.available - (self.peak - self.program) + (self.surfels or 0) * self.bytes_of_surfel / 1e6
        return max(int(rest * 1e6 / self.bytes_of_surfel), 0)

    @property
    def disk(self) -> float:
        """Of the run's folder: two checkpoints, as the new one is written before the old one goes, the base, masks.

        With as many surfels as there are at the start where nothing bounds them.
        """
        return self.run_disk + (self.surfels or self.seeds) * self.disk_bytes_of_surfel / 1e6

    @property
    def room_on_disk(self) -> int:
        """How many surfels the disk of the run's folder has room for."""
        rest = self.free_disk - self.run_disk - self.temporary * self.one_disk
        return max(int(rest * 1e6 / self.disk_bytes_of_surfel), 0)

    def told(self) -> str:
        """One sentence about memory."""
        there = "" if self.available is None else f"; {self.available / 1000:.1f} GB are free beside this program"
        parts = f"about {self.peak / 1000:.1f} GB at most"
        if self.surfels is not None:
            before = f", {self.grown:,} before those at borders are split" if self.split > 1 else ""
            return f"{parts}, with {self.surfels:,} Gaussians{before}{there}"
        room = "" if self.room is None else f": there is room for {self.room:,} of them"
        return f"{parts}, and {self.bytes_of_surfel / 1000:.1f} kB for each Gaussian{there}{room}"

    def told_of_disk(self) -> str:
        """One sentence about disks."""
        of_surfel = f", and {self.disk_bytes_of_surfel / 1000:.1f} kB for each Gaussian" if self.surfels is None else ""
        least = self.run_disk if self.surfels is None else self.disk
        room = f": there is room for {self.room_on_disk:,} of them" if self.surfels is None else ""
        there = f"{self.free_disk / 1000:.1f} GB are free"
        if not self.one_disk:
            there += f", and {self.free_temporary / 1000:.1f} GB for temporary files"
        parts = f"about {least / 1000:.2f} GB at most for the run{of_surfel}"
        return f"{parts}, {self.temporary / 1000:.2f} GB for temporary files meanwhile; {there}{room}"

    def lacking(self) -> str | None:
        """What there is too little of, and what to do, as the rest of a sentence; None where all is there."""
        sure = self.grown or self.seeds  # few may be at borders, and a training saves before memory runs out
        if self.room is not None and self.room < sure:
            return SMALLER
        if self.room_on_disk < sure:
            return f"the run needs {self.told_of_disk()}: free some space, or choose another folder with --run-dir"
        if self.temporary > self.free_temporary:
            return (
                f"temporary files need {self.temporary / 1000:.2f} GB and {self.free_temporary / 1000:.2f} GB are free "
                "there: name another folder with TMPDIR"
            )
        return None


def forecast(
    config: BeagsTrainerConfig,
    train_sizes: list[tuple[int, int]],
    eval_sizes: list[tuple[int, int]],
    seeds: int,
    grows: bool = True,
    device: str = "cpu",
    program: float = PROGRAM_MB,
) -> Forecast:
    """What a run will need.

    train_sizes, eval_sizes: (width, height) of every view. seeds: Gaussians to start from. grows: whether their number
    will grow. device: "cpu" or another, of whose memory nothing is known. program: what the process holds, MB.
    """
    model, data = config.model_config, config.data_config
    pixels = [width * height for width, height in train_sizes]
    held_out = [width * height for width, height in eval_sizes]
    densify = model.densify.bounded(sum(pixels))
    grows = grows and model.schedule().base_steps > 0
    most = None if grows and densify.max_surfels <= 0 else max(seeds, densify.max_surfels if grows else 0)
    rounds = model.refine_rounds if model.schedule().refine_steps > 0 else 0
    floats = 11 + 3 * (model.sh_degree + 1) ** 2
    photo = 3 * (1 if data.cache_images_type == "uint8" else 4)
    kept = [split for split in (pixels, held_out) if not _streams(data, sum(split) * photo / 1e9)]
    prepares = model.schedule().refine_steps > 0
    everywhere = sum(pixels) / 1e6
    preparation = min(PREPARATION_MB, everywhere * PREPARATION_BYTES_OF_PIXEL)
    reprojection = model.prepare.reprojection
    if reprojection == "pairwise" or (reprojection == AUTO and sum(pixels) <= PAIRWISE_PIXELS):
        preparation += everywhere * PAIRWISE_BYTES_OF_PIXEL
    scene_bytes = 4 * floats + 8  # with class and margin
    run, temporary = config.get_base_dir(), Path(tempfile.gettempdir())
    depth = DEPTH_BYTES_OF_PIXEL * (reprojection != "none")
    return Forecast(
        program=program,
        views=sum(sum(split) for split in kept) * (photo + 1) / 1e6,
        drawing=STEP_MB + max([*pixels, *held_out]) * BYTES_OF_PIXEL / 1e6,
        preparation=(STEP_MB + preparation) * prepares,
        seeds=seeds,
        grown=most,
        split=GROWTH_OF_SPLIT ** (model.split.rounds * rounds),
        bytes_of_surfel=4 * 4 * floats
        + 3 * 4 * floats
        + SURFEL_SCRATCH,  # with gradients, two moments; copies in growth
        available=available_mb() if device == "cpu" else None,
        run_disk=RUN_MB + everywhere * PREPARED_BYTES_OF_PIXEL * rounds,
        # two checkpoints with two moments of each number, the base, and each round's split scene
        disk_bytes_of_surfel=2 * (scene_bytes + 2 * 4 * floats) + (1 + rounds) * scene_bytes,
        temporary=everywhere * (TEMPORARY_BYTES_OF_PIXEL + depth) * (rounds > 0),
        free_disk=_free_disk(run) + _size(run),  # a run that goes on writes over what it has
        free_temporary=_free_disk(temporary),
        one_disk=_existing(run).stat().st_dev == _existing(temporary).stat().st_dev,
    )


def check_memory(found: Forecast) -> None:
    """Raise ``UserError`` where the run cannot end well."""
    lacking = found.lacking()
    if lacking is not None:
        raise UserError(
            f"this run would take {found.told()}: {lacking}; --check-memory False (beags resume: --no-check-memory) "
            "tries it all the same."
        )


def checks_of_run(data: Path, preset: str, downscale_factor: float = 1.0) -> list[Check]:
    """What the doctor says of a training on ``data``: its memory and its disk. Raises ``UserError`` for bad data."""
    from beags_plugin.plugin.presets import preset_config

    found = forecast_of_data(preset_config(preset, {}, Path(preset)), data, downscale_factor)
    fits = found.room is None or found.room >= (found.surfels or found.seeds)
    stored = found.room_on_disk >= (found.surfels or found.seeds) and found.temporary <= found.free_temporary
    return [
        Check(f"memory of {preset}", fits, found.told(), False, "" if fits else SMALLER),
        Check(f"disk of {preset}", stored, found.told_of_disk(), False),
    ]


def forecast_of_data(config: BeagsTrainerConfig, data: Path, downscale_factor: float = 1.0) -> Forecast:
    """What a training with ``config`` on ``data`` will need, before it is begun; raises ``UserError`` for bad data."""
    from beags_plugin.plugin.training.replicas import default_device
    from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

    parser = BeagsDataParserConfig(data=data, downscale_factor=downscale_factor).setup()
    outputs = [parser.get_dataparser_outputs(split) for split in ("train", "val")]
    train_sizes, eval_sizes = (torch.cat([one.cameras.width, one.cameras.height], 1).tolist() for one in outputs)
    seeds = len(outputs[0].metadata["points3D_xyz"])
    program = max(PROGRAM_MB, memory_mb())  # this process has the same libraries
    return forecast(config, train_sizes, eval_sizes, seeds, device=default_device(), program=program)


class MemoryWatch:
    """Ends a training that is about to take the last of the machine's memory, while its steps can still be saved."""

    EVERY = 20  # steps

    def __init__(self, device: str) -> None:
        self._on = device == "cpu"

    def short_of(self, step: int) -> str | None:
        """What to say if memory runs out after ``step``; None as long as there is enough, or where nobody knows."""
        if not self._on or step % self.EVERY:
            return None
        left = available_mb()
        if left is None or left >= LEAST_FREE_MB:
            return None
        return f"the machine has {left:.0f} MB of memory left, and this training takes {memory_mb():.0f} MB"


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory could not be had: Python's error, that of the compiled code, torch's on a CPU or a GPU."""
    text = str(error)
    return isinstance(error, MemoryError) or (
        (isinstance(error, OSError) and error.errno == errno.ENOMEM)
        or isinstance(error, RuntimeError)
        and any(words in text for words in ("can't allocate memory", "Cannot allocate memory", "out of memory"))
    )


def _streams(data, gigabytes: float) -> bool:
    return gigabytes > data.stream_above_gb if data.stream == "auto" else data.stream == "always"


def _free_disk(folder: Path) -> float:
    return shutil.disk_usage(_existing(folder)).free / 1e6


def _size(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _existing(folder: Path) -> Path:
    """The folder, or the first above it that is there."""
    return next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
