"""Parsers of what a run leaves: checkpoints and grids."""

from __future__ import annotations

import io
import zipfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from beags_plugin.system.errors import UserError
from parser_targets.target import Target


def _checkpoint(path: Path) -> None:
    from beags_plugin.importers.checkpoint import _gaussians
    from beags_plugin.plugin.training.resumable import training_state
    from beags_plugin.runs.checkpoint_file import read_checkpoint, validate

    try:
        state = read_checkpoint(path)
        validate({k.removeprefix("_model."): v for k, v in state["pipeline"].items() if isinstance(k, str)}, path)
        training_state(state, path)
    except UserError:
        _gaussians(path)
        raise


def _grid(path: Path) -> None:
    from beags_plugin.runs.prepared import read_grid

    read_grid(path)


def _saved(content: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def _checkpoint_content() -> dict[str, Any]:
    shapes = {"means": (2, 3), "quats": (2, 4), "scales": (2, 2), "opacities": (2, 1), "features_dc": (2, 3)}
    state: dict[str, Any] = {f"_model.gauss_params.{name}": torch.ones(shape) for name, shape in shapes.items()}
    state["_model.gauss_params.features_rest"] = torch.zeros(2, 3, 3)
    state |= {"_model.class_ids": torch.zeros(2, dtype=torch.int32), "_model.class_margin": torch.ones(2)}
    state |= {"_model.assigned": torch.tensor(True), "_model.extent": torch.tensor(1.0)}
    state["_model._extra_state"] = {"classes": {0: "background"}}
    parts = {"views": {"sizes": [1, 1]}}
    return {"step": 3, "pipeline": state, "optimizers": {}, "scalers": {}, "beags": {"version": 1, "parts": parts}}


def _pickle_of(content: Any) -> bytes:
    with zipfile.ZipFile(io.BytesIO(_saved(content))) as archive:
        return archive.read(next(name for name in archive.namelist() if name.endswith("data.pkl")))


def _with_pickle(content: bytes) -> bytes:
    """Return a checkpoint whose list of contents is these bytes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, member in _checkpoint_members().items():
            archive.writestr(name, content if name.endswith("data.pkl") else member)
    return file.getvalue()


@lru_cache(None)
def _checkpoint_members() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(_saved(_checkpoint_content()))) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _grid_files() -> list[bytes]:
    state = {
        "voxel_size": torch.tensor(0.1, dtype=torch.float64),
        "origin": torch.zeros(3, dtype=torch.float64),
        "num_classes": torch.tensor(2),
        "keys": torch.arange(3),
        "classes": torch.zeros(3, dtype=torch.int32),
    }
    return [_saved(state), _saved({})]


TARGETS = {
    "checkpoint": Target("step-000000003.ckpt", _checkpoint, lambda: [_saved(_checkpoint_content())]),
    "checkpoint pickle": Target(
        "step-000000003.ckpt", _checkpoint, lambda: [_pickle_of(_checkpoint_content())], _with_pickle
    ),
    "voxel grid": Target("grid.pt", _grid, _grid_files),
}
