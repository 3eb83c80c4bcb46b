"""Turns of a scene whose file does not tell its axes: programs disagree on what is up in .spz, .glb and USD files."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels
from beags_plugin.splat_io.frames import to_input_frame

Measured = tuple[Surfels, dict[str, Any]]


def quarter_turns() -> dict[str, Tensor]:
    """Return rotations [3, 3] float64 by what they do: those between frames with y or z up or down."""
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    found = {}
    for quarters, words in enumerate(
        ("", "a quarter turn about x", "half a turn about x", "a quarter turn back about x")
    ):
        angle = quarters * math.pi / 2
        about_x = torch.eye(3, dtype=torch.float64)
        about_x[1:, 1:] = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        ).round()
        if words:
            found[words] = about_x
        found[" after ".join(filter(None, (words, "half a turn about z")))] = about_x @ flip
    return found


def turned_to_fit(
    surfels: Surfels, moved: Callable[[Surfels], Surfels], measure: Callable[[Surfels], float]
) -> tuple[str, Surfels, float]:
    """Return the turn of the file's axes with which a scene fits best, the scene so moved, and its PSNR.

    surfels: as read. moved: into the run's frame. measure: the PSNR of some views.
    """
    best: tuple[str, Surfels, float] | None = None
    for words, rotation in quarter_turns().items():
        undo = torch.cat([rotation.T, torch.zeros(3, 1, dtype=torch.float64)], dim=1)
        candidate = moved(to_input_frame(surfels, undo, 1.0))
        found = measure(candidate)
        if best is None or found > best[2]:
            best = words, candidate, found
    assert best is not None
    return best
