"""Checkpoints of nerfstudio runs: of splatfacto (Gaussians with volume) and of ours (surfels)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from beags_plugin.core.flattening import Gaussians
from beags_plugin.core.sh import sh_basis
from beags_plugin.importers.base import ImportedScene, Importer
from beags_plugin.splat_io.frames import TRANSFORM_FILE, read_transform
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.reading.text import reason

_PREFIX = "_model.gauss_params."


class CheckpointImporter(Importer):
    """A run (its folder or config.yml), its nerfstudio_models, or one checkpoint of them.

    The scene lies in the run's normalised frame, which dataparser_transforms.json beside config.yml describes.
    """

    marks: ClassVar[str] = "a run of splatfacto or beags (its folder, config.yml or a .ckpt)"

    def recognises(self, path: Path) -> bool:
        return _newest(path) is not None

    def read(self, path: Path) -> ImportedScene:
        checkpoint = _newest(path)
        if checkpoint is None:
            raise UserError(f"{path} holds no checkpoint (step-….ckpt): name a run of splatfacto or beags.")
        gaussians = _gaussians(checkpoint)
        flat = gaussians.log_scales.shape[1] == 2
        run = checkpoint.absolute().parent.parent
        normalization = read_transform(run)
        note = ""
        if normalization is None:
            note = f"{run / TRANSFORM_FILE} is missing, so {checkpoint.name} is taken to lie in this run's own frame."
        return ImportedScene("run of beags" if flat else "run of splatfacto", gaussians, normalization, note)


def _newest(path: Path) -> Path | None:
    """Return ``path`` if it is a checkpoint, or the newest checkpoint of a run; None for others."""
    if path.is_file() and path.suffix == ".ckpt":
        return path
    run = path.parent if path.name == "config.yml" else path
    for folder in (run, run / "nerfstudio_models"):
        if checkpoints := sorted(folder.glob("step-*.ckpt")):
            return checkpoints[-1]
    return None


def _gaussians(checkpoint: Path) -> Gaussians:
    """Read the Gaussians of a checkpoint from a file that is mapped into memory; nothing but tensors is loaded."""
    try:
        content = load_tensors(checkpoint, mmap=True)
        if not isinstance(content, dict) or not isinstance(content.get("pipeline"), dict):
            raise ValueError("it holds no pipeline")
        state = content["pipeline"]
        parameters = {name[len(_PREFIX) :]: value for name, value in state.items() if name.startswith(_PREFIX)}
    except OSError as error:
        raise UserError(f"{checkpoint} cannot be read ({error.strerror}): name an existing checkpoint.") from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(f"{checkpoint} is not a checkpoint of nerfstudio ({reason(error)}): name another.") from error
    tensors = _checked(checkpoint, parameters)
    dc, rest, scales = tensors["features_dc"], tensors["features_rest"], tensors["scales"]
    if scales.shape[1] == 3 and rest.shape[1] == 0:
        # splatfacto without higher bands optimises logits of the colour
        dc = (torch.sigmoid(dc) - 0.5) / sh_basis(torch.tensor([[0.0, 0.0, 1.0]]), 0)
    return Gaussians(tensors["means"], tensors["quats"], scales, tensors["opacities"][:, 0], dc, rest)


def _checked(checkpoint: Path, parameters: dict[str, Any]) -> dict[str, Tensor]:
    """Copy the tensors to float32; raises ``UserError`` for shapes that do not fit together or into the file."""
    means = parameters.get("means")
    count = means.shape[0] if isinstance(means, Tensor) and means.dim() == 2 else -1
    shapes: dict[str, tuple[tuple[int, ...], ...]] = {
        "means": ((3,),),
        "quats": ((4,),),
        "scales": ((2,), (3,)),
        "opacities": ((1,),),
        "features_dc": ((3,),),
        "features_rest": ((0, 3), (3, 3), (8, 3), (15, 3)),
    }
    size = checkpoint.stat().st_size
    tensors = {}
    for name, allowed in shapes.items():
        value = parameters.get(name)
        if not isinstance(value, Tensor) or not value.is_floating_point():
            raise UserError(f"{checkpoint} holds no splatfacto or beags scene: it has no gauss_params.{name}.")
        if tuple(value.shape[:1]) != (count,) or tuple(value.shape[1:]) not in allowed:
            raise UserError(f"{checkpoint} is damaged: gauss_params.{name} is {list(value.shape)}.")
        if value.numel() * value.element_size() > size:  # an expanded view of few numbers
            raise UserError(f"{checkpoint} is damaged: gauss_params.{name} is larger than the file.")
        tensors[name] = value.to(torch.float32, copy=True).contiguous()
    return tensors
