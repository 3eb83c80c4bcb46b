"""Scenes to start from that cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from run_folders import discs

from beags_plugin.extraction.ply import write_ply
from mistakes.table import Place, mistake

COLUMNS = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
COLUMNS += [f"rot_{i}" for i in range(4)]


def start(at: Place, path: Path, *flags: str, **settings: Any):
    return at.train("--pipeline.model.start-from", str(path), *flags, preset="beags-refine", **settings)


def ply(change: Callable[[Path], Any]) -> Callable[[Place], Any]:
    """A mistake in a splat .ply."""

    def make(at: Place):
        path = at.root / "scene.ply"
        surfels, _ = discs()
        write_ply(path, surfels)
        change(path)
        return start(at, path)

    return make


def text(header: str, rows: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(f"ply\nformat ascii 1.0\n{header}end_header\n{rows}")


def splats(count: int, columns: list[str] = COLUMNS) -> str:
    return f"element vertex {count}\n" + "".join(f"property float {name}\n" for name in columns)


mistake("starts", "a .ply without vertices")(ply(text(splats(0), "")))
mistake("starts", "a .ply that promises 10^15 vertices")(ply(text(splats(10**15), "0 0 0\n")))
mistake("starts", "a .ply with half a colour band")(ply(text(splats(1, [*COLUMNS, "f_rest_0"]), "0 " * 15 + "\n")))
mistake("starts", "a .ply with an endless list")(
    ply(text(splats(1) + "property list uint float more\n", "0 " * 14 + "4000000000 0\n"))
)


@mistake("starts", "no such file")
def _(at: Place):
    return start(at, at.root / "scene.ply")


@mistake("starts", "something else")
def _(at: Place):
    (at.root / "scene.obj").write_text("v 0 0 0")
    return start(at, at.root / "scene.obj")


@mistake("starts", "an unknown format")
def _(at: Place):
    (at.root / "scene.ply").write_text("ply")
    return start(at, at.root / "scene.ply", "--pipeline.model.start-format", "splat")


@mistake("starts", "nothing to refine")
def _(at: Place):
    return at.train(preset="beags-refine")


@mistake("starts", "a checkpoint without a scene")
def _(at: Place):
    torch.save({"pipeline": {"weights": torch.zeros(3)}}, at.root / "step-000000001.ckpt")
    return start(at, at.root / "step-000000001.ckpt")


@mistake("starts", "a checkpoint of odd shapes")
def _(at: Place):
    content = torch.load(at.checkpoint, weights_only=True)
    content["pipeline"]["_model.gauss_params.quats"] = torch.zeros(3, 7)
    torch.save(content, at.checkpoint)
    return start(at, at.run)


@mistake("starts", "a checkpoint cut off")
def _(at: Place):
    at.cut(at.checkpoint)
    return start(at, at.run)
