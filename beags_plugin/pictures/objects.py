"""Sheets, comparisons and films of objects alone before a plain background."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.pictures.cells import GAP, as_bytes, below, beside, cell, checkerboard, wrapped
from beags_plugin.pictures.options import Background
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs

_WIDTH = 1920  # pixels of the width of a sheet; further cells go below

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Subject:
    """One object to show.

    stages: caption to the Gaussians alone, such as {"before": ..., "after": ...}, or {"": ...}. cameras: cameras for
    all stages. settings: depth range of the cameras.
    """

    name: str
    stages: Mapping[str, Surfels]
    cameras: Sequence[Camera]
    settings: RasterSettings


def render_alone(
    surfels: Surfels, camera: Camera, settings: RasterSettings, rasterizer: Rasterizer, background: Background
) -> np.ndarray:
    """Return Gaussians before a background, [H, W, 3] uint8."""
    behind = torch.from_numpy(_behind(camera.height, camera.width, background))
    with torch.no_grad():
        if len(surfels) == 0:
            return behind.numpy()
        inputs = surfel_inputs(surfels.detach(), camera)
        render = rasterizer.rasterize(inputs, camera, settings, surfels.means.new_zeros(3))
    color = render.color.cpu() + (1.0 - render.alpha.cpu())[..., None] * behind.float() / 255.0
    return as_bytes(color)


def _behind(height: int, width: int, background: Background) -> np.ndarray:
    if background == "checker":
        return checkerboard(height, width, 12).astype(np.uint8)[..., None].repeat(3, axis=2)
    return np.full((height, width, 3), 255 if background == "white" else 0, dtype=np.uint8)


def film(
    subjects: Sequence[Subject], rasterizer: Rasterizer, background: Background, progress: Progress | None = None
) -> Iterator[np.ndarray]:
    """Yield frames [H, W, 3] uint8 of even size with all subjects and stages beside each other."""
    count = len(subjects[0].cameras)
    for index in range(count):
        groups = [_stages(subject, index, rasterizer, background) for subject in subjects]
        alone = len(groups) == len(groups[0]) == 1
        yield _even(groups[0][0] if alone else below(wrapped(groups, _WIDTH)))
        if progress:
            progress(index + 1, count)


def sheet(
    subjects: Sequence[Subject], rasterizer: Rasterizer, background: Background, progress: Progress | None = None
) -> np.ndarray:
    """Return [H, W, 3] uint8: one or more lines for each subject and stage, with a picture for each camera."""
    lines, done = [], 0
    total = sum(len(subject.cameras) * len(subject.stages) for subject in subjects)
    for subject in subjects:
        for stage, surfels in subject.stages.items():
            pictures = []
            for number, camera in enumerate(subject.cameras):
                picture = render_alone(surfels, camera, subject.settings, rasterizer, background)
                caption = _caption(subject.name, stage) if number == 0 else ""
                pictures.append([cell(picture, (camera.width, camera.height), caption)])
                done += 1
                if progress:
                    progress(done, total)
            lines += wrapped(pictures, _WIDTH)
    return below(lines)


def comparison(
    subjects: Sequence[Subject], rasterizer: Rasterizer, background: Background, progress: Progress | None = None
) -> np.ndarray:
    """Return [H, W, 3] uint8: subjects beside each other, each with its stages in a line for each camera."""
    blocks, done = [], 0
    total = sum(len(subject.cameras) for subject in subjects)
    for subject in subjects:
        lines = []
        for index in range(len(subject.cameras)):
            lines.append(beside(_stages(subject, index, rasterizer, background)))
            done += 1
            if progress:
                progress(done, total)
        blocks.append([below(lines)[:-GAP, :-GAP]])
    return below(wrapped(blocks, _WIDTH))


def _stages(subject: Subject, index: int, rasterizer: Rasterizer, background: Background) -> list[np.ndarray]:
    """Return a picture for each stage of a subject from one of its cameras, below its caption if there is one."""
    camera = subject.cameras[index]
    cells = []
    for stage, surfels in subject.stages.items():
        picture = render_alone(surfels, camera, subject.settings, rasterizer, background)
        caption = _caption(subject.name, stage)
        cells.append(cell(picture, (camera.width, camera.height), caption) if caption else picture)
    return cells


def _caption(name: str, stage: str) -> str:
    return ", ".join(filter(None, (name, stage)))


def _even(picture: np.ndarray) -> np.ndarray:
    """Pad odd sides with a white line: films store colour for squares of 2 x 2 pixels."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), constant_values=255)
