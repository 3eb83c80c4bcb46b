"""A run that starts from a trained scene instead of seed points."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from beags_plugin.core.cameras import camera_extent
from beags_plugin.core.flattening import flatten, without_empty_bands
from beags_plugin.core.surfels import Surfels
from beags_plugin.importers.base import ImportedScene, read_scene
from beags_plugin.losses.photometric import psnr
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.training.start_axes import turned_to_fit
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.splat_io.far_worlds import double_means, origin_of
from beags_plugin.splat_io.frames import from_input_frame, to_input_frame
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.views.views import View

START_REPORT = "start.json"  # file of a run that started from a scene: the scene, and how well it fits
StartFrame = Literal["auto", "world", "normalised"]
_MOST_VIEWS = 48  # rendered to measure the fit
_POOR_DB = 2.0  # a scene that fits is better than one flat colour by more than this
_BETTER_DB = 3.0  # by which another frame must fit better to be proposed

Normalization = tuple[Tensor, float]


def start_from_scene(model: SceneModel, datamanager: BeagsDataManager, run: Path) -> None:
    """Put the scene of ``start_from`` in place of the seed points, and report the scene and how well it fits.

    run: folder of the run, for ``start.json``. Raises ``UserError`` for a scene that cannot be used.
    """
    config = model.config
    assert config.start_from is not None
    path = Path(config.start_from)
    scene = read_scene(path, config.start_values)
    usable = scene.gaussians.usable()
    if not bool(usable.any()):
        raise UserError(f"{path} holds no Gaussian that can be used: name another scene.")
    surfels, lost = flatten(scene.gaussians[usable])
    surfels = without_empty_bands(surfels)
    surfels, shift = _placed(path, scene, usable, surfels)
    outputs = datamanager.train_dataparser_outputs
    ours = (outputs.dataparser_transform, float(outputs.dataparser_scale))
    views = datamanager.views("train")
    frames: Sequence[StartFrame] = ("auto", "world", "normalised")
    frames = frames if config.start_frame == "auto" else (config.start_frame,)
    candidates: dict[StartFrame, Surfels] = {name: _moved(surfels, scene, name, ours, shift) for name in frames}
    frame = frames[0]
    fit, turn = _measure(model, candidates[frame], views), ""
    if scene.doubtful_axes and _poor(fit):
        words, turned, found = turned_to_fit(
            surfels,
            lambda scene_turned: _moved(scene_turned, scene, frame, ours, shift),
            lambda scene_moved: _measure(model, scene_moved, views, most=8)["psnr"],
        )
        if found > fit["psnr"] + _BETTER_DB:
            turn, candidates[frame] = words, turned
            before, fit = fit["psnr"], _measure(model, turned, views)
            scene = replace(
                scene,
                remarks=(*scene.remarks, f"Its axes fit these poses after {turn} ({before:.1f} dB as it stands)."),
            )
    model.replace_surfels(candidates[frame])
    report = {
        "from": str(path.absolute()),
        "kind": scene.kind,
        "frame": _frame_name(frame, scene),
        **({"turned": turn} if turn else {}),
        "gaussians": len(surfels),
        "dropped": int((~usable).sum()),
        "flattening": None if lost is None else vars(lost),
        "remarks": list(scene.remarks),
        **fit,
    }
    if held_out := datamanager.views("eval"):
        report["held_out"] = _measure(model, candidates[frame], held_out)
    for line in _description(path, scene, report):
        CONSOLE.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)
    if _poor(fit):
        _warn_of_poor_fit(model, path, fit, candidates, views)
    write_text_atomically(json.dumps(report, indent=2), run / START_REPORT)


def _poor(fit: dict[str, Any]) -> bool:
    return fit["psnr"] < fit["flat_psnr"] + _POOR_DB


def _frame_name(frame: StartFrame, scene: ImportedScene) -> str:
    if frame != "auto":
        return frame
    if scene.note:
        return "normalised"
    return "world" if scene.normalization is None else "normalised as its own run"


def _placed(path: Path, scene: ImportedScene, usable: Tensor, surfels: Surfels) -> tuple[Surfels, Tensor | None]:
    """Return the surfels of the ``usable`` [N] Gaussians, and where 0 of their file lies, [3] float64, or None for 0.

    Those of a world far from 0 whose file has places in double precision are in float64.
    """
    exact = scene.exact_means if scene.exact_means is not None else double_means(path, len(usable))
    if exact is not None:
        return replace(_double(surfels), means=exact[usable].to(surfels.means.device)), None
    return surfels, origin_of(path) if path.is_file() else None


def _double(surfels: Surfels) -> Surfels:
    return Surfels(**{field.name: getattr(surfels, field.name).double() for field in fields(surfels)})


def _moved(
    surfels: Surfels, scene: ImportedScene, frame: StartFrame, ours: Normalization, shift: Tensor | None = None
) -> Surfels:
    """Return the Gaussians in the frame of this run, x' = scale (R x + t) of the input's x, in float32.

    shift: [3] float64, where 0 of their frame lies in the input's world; None for 0.
    """
    theirs = scene.normalization
    moved = _double(surfels)
    if not (frame == "normalised" or (frame == "auto" and (scene.note or _same(theirs, ours)))):
        if shift is not None:
            moved = replace(moved, means=moved.means + shift.to(moved.means.device))
        if frame == "auto" and theirs is not None:
            moved = to_input_frame(moved, *theirs)
        moved = from_input_frame(moved, *ours)
    return Surfels(**{field.name: getattr(moved, field.name).float() for field in fields(moved)})


def _same(theirs: Normalization | None, ours: Normalization) -> bool:
    """Return whether two runs normalised alike; the file keeps float32 in decimal."""
    return theirs is not None and torch.equal(theirs[0].float(), ours[0].float()) and math.isclose(theirs[1], ours[1])


@torch.no_grad()
def _measure(model: SceneModel, surfels: Surfels, views: Sequence[View], most: int = _MOST_VIEWS) -> dict[str, Any]:
    """Return the mean PSNR of the rendered Gaussians and of one flat colour over some training views, dB."""
    device = model.device
    surfels = Surfels(**{field.name: getattr(surfels, field.name).to(device) for field in fields(surfels)})
    poses = torch.stack([torch.linalg.inv(view.camera.viewmat) for view in views])
    model.extent = camera_extent(poses).to(device)
    settings = model.settings(geometry=False)
    spread = torch.linspace(0, len(views) - 1, min(most, len(views))).round().long().unique()
    chosen = [views[index] for index in spread]
    found = []
    with progress_bar("Rendering the start") as progress:
        for number, view in enumerate(chosen):
            image = view.image_on(model.background_color).to(device)
            color = model.rasterizer.rasterize(
                surfel_inputs(surfels, view.camera), view.camera, settings, model.background_color.to(device)
            ).color.clamp(0.0, 1.0)
            flat = image.mean(dim=(0, 1))
            found.append([float(psnr(color, image)), float(psnr(flat, image))])
            progress(number + 1, len(chosen))
    scene_psnr, flat_psnr = (sum(values) / len(values) for values in zip(*found, strict=True))
    return {"psnr": scene_psnr, "flat_psnr": flat_psnr, "views": len(chosen)}


def _description(path: Path, scene: ImportedScene, report: dict[str, Any]) -> list[str]:
    """Describe the start for the user, a line each."""
    dropped = report["dropped"]
    counted = f"{report['gaussians']:,} Gaussians" + (f" ({dropped:,} dropped: not finite)" if dropped else "")
    lines = [f"start: {path} ({scene.kind}), {counted}, frame: {report['frame']}"]
    lines += [sentence for sentence in (scene.note, *scene.remarks) if sentence]
    if (lost := report["flattening"]) is not None:
        lines.append(
            f"flattened along the thinnest axis, which is {lost['median_ratio']:.3f} of the second (median); "
            f"above half of it for {100 * lost['round_share']:.0f} % of the Gaussians"
        )
    lines.append(
        f"PSNR of {report['views']} training views as it starts: {report['psnr']:.2f} dB "
        f"(one flat colour: {report['flat_psnr']:.2f})"
    )
    return lines


def _warn_of_poor_fit(
    model: SceneModel, path: Path, fit: dict[str, Any], candidates: dict[StartFrame, Surfels], views: Sequence[View]
) -> None:
    """Warn that the frame or the scale probably does not fit, and name the frame that does, if one does."""
    sentence = (
        f"{path} draws the training views with {fit['psnr']:.1f} dB, hardly better than one flat colour "
        f"({fit['flat_psnr']:.1f} dB): its frame or scale probably does not fit these poses"
    )
    tried = {name: _measure(model, moved, views, most=8)["psnr"] for name, moved in candidates.items()}
    best = max(tried, key=lambda name: tried[name])
    if tried[best] > fit["psnr"] + _BETTER_DB:
        sentence += f"; it fits better with --pipeline.model.start-frame {best} ({tried[best]:.1f} dB)"
    CONSOLE.print(f"{sentence}.", style="yellow", markup=False, highlight=False, soft_wrap=True)
