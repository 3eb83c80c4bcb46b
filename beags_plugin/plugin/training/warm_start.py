"""A run that starts from a trained scene instead of seed points."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from beags_plugin.core.cameras import camera_extent
from beags_plugin.core.flattening import flatten, without_empty_bands
from beags_plugin.core.surfels import Surfels
from beags_plugin.importers.base import ImportedScene, read_scene
from beags_plugin.losses.photometric import psnr
from beags_plugin.plugin.training.scene_model import SceneModel, picture
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.splat_io.far_worlds import double_means, origin_of
from beags_plugin.splat_io.frames import from_input_frame, to_input_frame
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import progress_bar, say
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.views.views import View

START_REPORT = "start.json"  # File of a run that started from a scene: which scene, and how well it fits.
StartFrame = Literal["auto", "world", "normalised"]
_MOST_VIEWS = 48  # Views rendered to measure the fit.
_POOR_DB = 2.0  # A scene that fits beats one flat colour by more than this.
_BETTER_DB = 3.0  # Another frame is proposed only if it fits better by more than this.

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
        words, turned, psnr_turned = turned_to_fit(
            surfels,
            lambda scene_turned: _moved(scene_turned, scene, frame, ours, shift),
            lambda scene_moved: _measure(model, scene_moved, views, most=8)["psnr"],
        )
        if psnr_turned > fit["psnr"] + _BETTER_DB:
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
        say(f"  {line}")
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
    """Return the ``usable`` [N] Gaussians, flat, and the origin of their file, [3] float64, or None for 0.

    They are in float64 if the file has positions in double precision, as for a world far from 0.
    """
    exact = scene.exact_means if scene.exact_means is not None else double_means(path, len(usable))
    if exact is not None:
        return replace(surfels.to(torch.float64), means=exact[usable].to(surfels.means.device)), None
    return surfels, origin_of(path) if path.is_file() else None


def _moved(
    surfels: Surfels, scene: ImportedScene, frame: StartFrame, ours: Normalization, shift: Tensor | None = None
) -> Surfels:
    """Return the Gaussians in the frame of this run, x' = scale (R x + t) of the input's x, in float32.

    shift: [3] float64, the origin of their frame in the input's world; None for 0.
    """
    theirs = scene.normalization
    moved = surfels.to(torch.float64)
    if not (frame == "normalised" or (frame == "auto" and (scene.note or _same(theirs, ours)))):
        if shift is not None:
            moved = replace(moved, means=moved.means + shift.to(moved.means.device))
        if frame == "auto" and theirs is not None:
            moved = to_input_frame(moved, *theirs)
        moved = from_input_frame(moved, *ours)
    return moved.to(torch.float32)


def _same(theirs: Normalization | None, ours: Normalization) -> bool:
    """Return whether two runs have the same normalisation; the file has float32 values in decimal."""
    return theirs is not None and torch.equal(theirs[0].float(), ours[0].float()) and math.isclose(theirs[1], ours[1])


@torch.no_grad()
def _measure(model: SceneModel, surfels: Surfels, views: Sequence[View], most: int = _MOST_VIEWS) -> dict[str, Any]:
    """Return the mean PSNR of the rendered Gaussians, and of one flat colour, over some views, dB."""
    device = model.device
    surfels = surfels.to(device)
    poses = torch.stack([torch.linalg.inv(view.camera.viewmat) for view in views])
    model.extent = camera_extent(poses).to(device)
    spread = torch.linspace(0, len(views) - 1, min(most, len(views))).round().long().unique()
    chosen = [views[index] for index in spread]
    values = []
    with progress_bar("Rendering the start") as progress:
        for number, view in enumerate(chosen):
            image = view.image_on(model.background_color).to(device)
            color = picture(model, surfel_inputs(surfels, view.camera), view.camera)
            flat = image.mean(dim=(0, 1))
            values.append([float(psnr(color, image)), float(psnr(flat, image))])
            progress(number + 1, len(chosen))
    scene_psnr, flat_psnr = (sum(each) / len(each) for each in zip(*values, strict=True))
    return {"psnr": scene_psnr, "flat_psnr": flat_psnr, "views": len(chosen)}


def _description(path: Path, scene: ImportedScene, report: dict[str, Any]) -> list[str]:
    """Describe the start in lines for the user."""
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
        f"{path} renders the training views with {fit['psnr']:.1f} dB, hardly better than one flat colour "
        f"({fit['flat_psnr']:.1f} dB): its frame or scale probably does not fit these poses"
    )
    tried = {name: _measure(model, moved, views, most=8)["psnr"] for name, moved in candidates.items()}
    best = max(tried, key=lambda name: tried[name])
    if tried[best] > fit["psnr"] + _BETTER_DB:
        sentence += f"; it fits better with --pipeline.model.start-frame {best} ({tried[best]:.1f} dB)"
    say(f"{sentence}.", warning=True)


def quarter_turns() -> dict[str, Tensor]:
    """Return rotations [3, 3] float64, named in words, between frames with y or z up or down.

    Programs disagree on which axis is up in .spz, .glb and USD files.
    """
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    turns = {}
    for quarters, words in enumerate(
        ("", "a quarter turn about x", "half a turn about x", "a quarter turn back about x")
    ):
        angle = quarters * math.pi / 2
        about_x = torch.eye(3, dtype=torch.float64)
        about_x[1:, 1:] = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        ).round()
        if words:
            turns[words] = about_x
        turns[" after ".join(filter(None, (words, "half a turn about z")))] = about_x @ flip
    return turns


def turned_to_fit(
    surfels: Surfels, moved: Callable[[Surfels], Surfels], measure: Callable[[Surfels], float]
) -> tuple[str, Surfels, float]:
    """Return the turn of the file's axes with which a scene fits best, the moved scene, and its PSNR.

    surfels: as read. moved: moves them into the run's frame. measure: returns the PSNR of some views.
    """
    best: tuple[str, Surfels, float] | None = None
    for words, rotation in quarter_turns().items():
        undo = torch.cat([rotation.T, torch.zeros(3, 1, dtype=torch.float64)], dim=1)
        candidate = moved(to_input_frame(surfels, undo, 1.0))
        fit = measure(candidate)
        if best is None or fit > best[2]:
            best = words, candidate, fit
    assert best is not None
    return best
