"""The files of a preparation, from which a resumed refinement continues."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from beags_plugin.labels.classes import write_mask
from beags_plugin.plugin.training.contradiction import Residuals
from beags_plugin.preparation.pipeline import Preparation
from beags_plugin.runs.prepared import PREPARATION_REPORT
from beags_plugin.system.errors import writing
from beags_plugin.system.memory import peak_memory_mb
from beags_plugin.system.progress import counted, progress_bar
from beags_plugin.system.whole_files import write_text_atomically, write_whole


def save_prepared(
    prepared: Preparation, names: list[str], folder: Path, background_voxels: bool, fit: Residuals | None = None,
    magnified: float = 1.0,
) -> None:  # fmt: skip
    """Write what a resumed refinement needs; grid.pt comes last, as its presence marks the rest as complete.

    background_voxels: whether the grid kept those that there are. fit: of the base to the photos, for the report; None
    if it was not measured. magnified: objects in close-ups, over whole photos.
    """
    with writing(folder):
        (folder / "grid.pt").unlink(missing_ok=True)
        clear(folder)
        (folder / "masks").mkdir(parents=True, exist_ok=True)
        (folder / "confidence").mkdir(exist_ok=True)
    with progress_bar("Keeping masks", passing=True) as progress:
        for index, name in enumerate(counted(names, len(names), progress)):
            labels, path = prepared.labels[index], folder / "masks" / f"{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mask(path, labels.cpu().numpy().astype(np.uint16))
            if prepared.confidence is not None:
                path = folder / "confidence" / f"{name}.png"
                path.parent.mkdir(exist_ok=True)
                with writing(path):  # PIL is used because cv2 ignores a full disk.
                    Image.fromarray(prepared.confidence[index].cpu().numpy()).save(path)
    report = {
        "summary": prepared.summary,
        "seconds": prepared.seconds,
        "peak_memory_mb": peak_memory_mb(),
        "background_voxels": background_voxels,
        "magnified": magnified,
    }
    if prepared.agreement is not None:
        report["agreement"] = prepared.agreement.to_json(names[: len(prepared.agreement.errors)])
    if fit is not None:
        report["residuals"] = {**vars(fit), "contradict": fit.contradict}
    write_text_atomically(json.dumps(report, indent=2), folder / PREPARATION_REPORT)
    state = {} if prepared.grid is None else prepared.grid.state_dict()
    write_whole(folder / "grid.pt", lambda file: torch.save(state, file))


def clear(folder: Path) -> None:
    """Remove the files of another run in the same folder."""
    for path in folder.glob("*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
