"""How much memory and disk a run on a CPU will need, told before it is begun, and whether that is there."""

from __future__ import annotations

import errno
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from beags_plugin.doctor.check import Check
from beags_plugin.errors import UserError
from beags_plugin.plugin.memory import available_mb, memory_mb
from beags_plugin.refiners.consistent_masks import AUTO, PAIRWISE_PIXELS

if TYPE_CHECKING:
    from beags_plugin.plugin.config import BeagsTrainerConfig

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
    preparation: of the stages after the base, but for the surfels. surfels: how many at most; None where nothing
    bounds them. bytes_of_surfel: in memory, and checkpoint_bytes in a checkpoint. available: what there is beside
    the program; None where the system does not tell. free_disk: where the run will lie.
    """

    program: float
    views: float
    drawing: float
    preparation: float
    surfels: int | None
    bytes_of_surfel: float
    checkpoint_bytes: float
    available: float | None
    free_disk: float

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
        """Of two checkpoints, as the new one is written before the old one goes."""
        return 2 * (self.surfels or 0) * self.checkpoint_bytes / 1e6

    def told(self) -> str:
        """One sentence about memory."""
        there = "" if self.available is None else f"; {self.available / 1000:.1f} GB are free beside this program"
        parts = f"about {self.peak / 1000:.1f} GB at most"
        if self.surfels is not None:
            return f"{parts}, with {self.surfels:,} Gaussians{there}"
        room = "" if self.room is None else f": there is room for {self.room:,} of them"
        return f"{parts}, and {self.bytes_of_surfel / 1000:.1f} kB for each Gaussian{there}{room}"

    def lacking(self) -> str | None:
        """What there is too little of, and what to do, as the rest of a sentence; None where all is there."""
        if self.room is not None and self.room < max(self.surfels or 0, 1):
            return SMALLER
        if self.disk > self.free_disk:
            return f"checkpoints need {self.disk / 1000:.1f} GB of disk and {self.free_disk / 1000:.1f} GB are free"
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
    floats = 11 + 3 * (model.sh_degree + 1) ** 2
    photo = 3 * (1 if data.cache_images_type == "uint8" else 4)
    kept = [split for split in (pixels, held_out) if not _streams(data, sum(split) * photo / 1e9)]
    prepares = model.schedule().refine_steps > 0
    everywhere = sum(pixels) / 1e6
    preparation = min(PREPARATION_MB, everywhere * PREPARATION_BYTES_OF_PIXEL)
    reprojection = model.prepare.reprojection
    if reprojection == "pairwise" or (reprojection == AUTO and sum(pixels) <= PAIRWISE_PIXELS):
        preparation += everywhere * PAIRWISE_BYTES_OF_PIXEL
    return Forecast(
        program=program,
        views=sum(sum(split) for split in kept) * (photo + 1) / 1e6,
        drawing=STEP_MB + max([*pixels, *held_out]) * BYTES_OF_PIXEL / 1e6,
        preparation=(STEP_MB + preparation) * prepares,
        surfels=most,
        bytes_of_surfel=4 * 4 * floats
        + 3 * 4 * floats
        + SURFEL_SCRATCH,  # with gradients, two moments; copies in growth
        checkpoint_bytes=3 * 4 * floats,
        available=available_mb() if device == "cpu" else None,
        free_disk=_free_disk(config.get_base_dir()),
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
    from beags_plugin.plugin.dataparser import BeagsDataParserConfig
    from beags_plugin.plugin.presets import preset_config
    from beags_plugin.plugin.several import default_device

    config = preset_config(preset, {}, Path(preset))
    parser = BeagsDataParserConfig(data=data, downscale_factor=downscale_factor).setup()
    outputs = [parser.get_dataparser_outputs(split) for split in ("train", "val")]
    sizes = [torch.cat([one.cameras.width, one.cameras.height], 1).tolist() for one in outputs]
    seeds = len(outputs[0].metadata["points3D_xyz"])
    found = forecast(config, *sizes, seeds, device=default_device())
    fits = found.room is None or found.room >= max(found.surfels or 0, 1)
    disk = f"two checkpoints of {found.disk / 2000:.2f} GB" if found.surfels is not None else (
        f"two checkpoints, of {found.checkpoint_bytes / 1000:.1f} kB for each Gaussian"
    )  # fmt: skip
    return [
        Check(f"memory of {preset}", fits, found.told(), False, "" if fits else SMALLER),
        Check(
            f"disk of {preset}",
            found.disk <= found.free_disk,
            f"{disk}; {found.free_disk / 1000:.0f} GB are free",
            False,
        ),
    ]


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
    there = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(there).free / 1e6
