"""Scenes to start from that cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from run_folders import discs

from beags_plugin.splat_io.ply import write_ply
from mistakes.table import Place, mistakes

COLUMNS = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3))]
COLUMNS += [f"rot_{i}" for i in range(4)]


def start(at: Place, path: Path):
    return at.train("--pipeline.model.start-from", str(path), preset="beags-refine")


def ply(change: Callable[[Path], Any]) -> Callable[[Place], Any]:
    """Return a mistake in a splat .ply."""

    def make(at: Place):
        path = at.root / "scene.ply"
        write_ply(path, discs()[0])
        change(path)
        return start(at, path)

    return make


def text(header: str, rows: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(f"ply\nformat ascii 1.0\n{header}end_header\n{rows}")


def splats(count: int, columns: list[str] = COLUMNS) -> str:
    return f"element vertex {count}\n" + "".join(f"property float {name}\n" for name in columns)


def write_obj(at: Place) -> Path:
    (at.root / "scene.obj").write_text("v 0 0 0")
    return at.root / "scene.obj"


def bare_checkpoint(at: Place) -> Path:
    path = at.root / "step-000000001.ckpt"
    torch.save({"pipeline": {"weights": torch.zeros(3)}}, path)
    return path


def odd_checkpoint(at: Place) -> Path:
    content = torch.load(at.checkpoint, weights_only=True)
    content["pipeline"]["_model.gauss_params.quats"] = torch.zeros(3, 7)
    torch.save(content, at.checkpoint)
    return at.run


mistakes(
    "starts",
    {
        "a .ply without vertices": ply(text(splats(0), "")),
        "a .ply that promises 10^15 vertices": ply(text(splats(10**15), "0 0 0\n")),
        "a .ply with half a colour band": ply(text(splats(1, [*COLUMNS, "f_rest_0"]), "0 " * 15 + "\n")),
        "a .ply with an endless list": ply(
            text(splats(1) + "property list uint float more\n", "0 " * 14 + "4000000000 0\n")
        ),
        "no such file": lambda at: start(at, at.root / "scene.ply"),
        "something else": lambda at: start(at, write_obj(at)),
        "nothing to refine": lambda at: at.train(preset="beags-refine"),
        "a checkpoint without a scene": lambda at: start(at, bare_checkpoint(at)),
        "a checkpoint of odd shapes": lambda at: start(at, odd_checkpoint(at)),
        "a checkpoint cut off": lambda at: start(at, at.cut(at.checkpoint).parents[1]),
    },
)
