"""Which Gaussians of a run's objects do not belong to them: decided once, and stored beside the checkpoint."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut
from beags_plugin.runs.layout import PREPARED, files_digest, preparing_run
from beags_plugin.runs.read import SavedScene
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.whole_files import write_whole

BELONGING_FILE = "belonging.pt"  # It lies in a run's folder; once deleted, it is made anew.
RULE = 2
"""Version of the rule in ``cleaning.clean``; decisions of another version are made anew."""


class Belonging:
    """Decisions about the objects of a run, valid for its present Gaussians, classes and masks."""

    def __init__(self, scene: SavedScene, run: Path) -> None:
        self._path = run / BELONGING_FILE
        self._stamp = _stamp(scene, run)
        self._decided: dict[int, dict[str, Any]] = {}
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):  # A damaged file is replaced.
            content = load_tensors(self._path)
            if content["stamp"] == self._stamp:
                self._decided = {int(class_id): dict(each) for class_id, each in content["objects"].items()}

    def known(self, class_id: int) -> tuple[Tensor, LeftOut] | None:
        """Return the indices [K] int64 of the object's Gaussians in the scene that do not belong to it, and why.

        None where that has not been decided.
        """
        if (decision := self._decided.get(class_id)) is None:
            return None
        return decision["dropped"], LeftOut(**{name: decision[name] for name in asdict(LeftOut())})

    def keep(self, class_id: int, dropped: Tensor, left_out: LeftOut) -> None:
        """Store the decision about an object; the arguments are what ``known`` returns."""
        self._decided[class_id] = {"dropped": dropped, **asdict(left_out)}
        content = {"stamp": self._stamp, "objects": self._decided}
        with suppress(OSError, UserError):  # Without the file the decision only takes time again.
            write_whole(self._path, lambda file: torch.save(content, file))


def _stamp(scene: SavedScene, run: Path) -> str:
    """Return a digest of all that a decision depends on."""
    digest = hashlib.sha256(f"{RULE} {files_digest(preparing_run(run) / PREPARED)}".encode())
    members = scene.members
    objects = sorted((members.objects or {}).items())
    gaussians = (scene.state[f"gauss_params.{name}"] for name in ("means", "quats", "scales", "opacities"))
    for tensor in (*gaussians, members.class_ids, *(index for _, index in objects)):
        digest.update(f" {list(tensor.shape)} ".encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
