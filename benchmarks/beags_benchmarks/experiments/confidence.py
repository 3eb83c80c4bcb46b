"""A picture of reprojection on damaged masks: photo, masks before and after, confidence, errors, exact mask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.experiments.report import new_figure, save_figure
from beags_benchmarks.experiments.scenes import quiet
from beags_benchmarks.experiments.trials import VariantTrial
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.colors import colorize

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from beags_plugin.runs.prepared import TrainingMasks

SHOWN_DAMAGE = 2.0  # degree of damage that is shown, or the nearest one
VIEWS = 2  # views of each scene: the one that changed most, and one without a mask
_WRONG, _MENDED, _SPOILT, _UNKNOWN = (230, 75, 45), (60, 160, 90), (200, 0, 200), (170, 170, 170)


def plot_confidence(path: Path, runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome]) -> None:
    """Plot ``VIEWS`` of every scene, from the run whose damage is nearest to ``SHOWN_DAMAGE``."""
    rows = [(run.scene.name, view) for run in shown_runs(runs, outcomes) for view in _views(run, outcomes)]
    figure, axes = new_figure(6, max(len(rows), 1), size=(3.0, 2.6))
    for axis in axes.flat:
        axis.set_axis_off()
    for line, (scene, view) in zip(axes, rows, strict=False):
        _plot_view(line, scene, view)
    if not rows:
        axes[0, 0].set_title("no run with reprojection has finished", loc="left")
    save_figure(path, figure)


def shown_runs(runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome]) -> list[VariantTrial]:
    """Return for each scene the finished run with reprojection whose damage is nearest to ``SHOWN_DAMAGE``."""

    def distance(run: VariantTrial) -> float:
        return abs((run.variant.damage or 0.0) - SHOWN_DAMAGE)

    best: dict[str, VariantTrial] = {}
    for run in runs:
        outcome = outcomes[run.trial.digest]
        if outcome.failed is None and any((outcome.folder / "run/prepared/confidence").glob("*.png")):
            best[run.scene.name] = min(best.get(run.scene.name, run), run, key=distance)
    return list(best.values())


def _views(run: VariantTrial, outcomes: Mapping[str, Outcome]) -> list[TrainingMasks]:
    from beags_plugin.runs.prepared import training_masks
    from beags_plugin.runs.relocation import open_run

    with quiet():
        views = training_masks(open_run(outcomes[run.trial.digest].folder / "run/config.yml"))
    masked = [view for view in views if view.given is not None]
    changed = sorted(masked, key=lambda view: -int((view.given != view.used).sum()))
    return [*changed[: VIEWS - 1], *[view for view in views if view.given is None][:1]]


def _plot_view(axes: Sequence[Axes], scene: str, view: TrainingMasks) -> None:
    from PIL import Image

    height, width = view.used.shape
    with Image.open(view.photo) as image:
        axes[0].imshow(image.convert("RGB").resize((width, height)))
    axes[0].set_title(f"{scene}, {view.name}", loc="left")
    _plot_mask(axes[1], view.given, "mask, damaged", view.exact)
    _plot_mask(axes[2], view.used, "mask, reprojected", view.exact)
    if view.confidence.exists():
        with Image.open(view.confidence) as image:
            axes[3].imshow(np.asarray(image) / 255.0, cmap="magma", vmin=0.0, vmax=1.0)
    axes[3].set_title("confidence, black 0 to white 1", loc="left")
    if view.exact is not None:
        axes[4].imshow(_errors(view))
        axes[4].set_title(
            "green: corrected, red: still wrong,\nmagenta: newly wrong, grey: unlabelled", loc="left", fontsize=8
        )
    _plot_mask(axes[5], view.exact, "exact mask", None)


def _plot_mask(axes: Axes, mask: np.ndarray | None, title: str, exact: np.ndarray | None) -> None:
    if mask is None:
        axes.set_title(f"{title}: none", loc="left")
        return
    if exact is not None:
        known = (mask != IGNORE) & (exact != IGNORE)
        title += f": {100 * float((mask != exact)[known].mean()):.2f} % wrong" if known.any() else ""
    axes.imshow(colorize(mask))
    axes.set_title(title, loc="left")


def _errors(view: TrainingMasks) -> np.ndarray:
    """Return [h, w, 3] uint8 with the wrong pixels before and after; unlabelled pixels are not wrong."""
    assert view.exact is not None
    picture = np.full((*view.used.shape, 3), 235, dtype=np.uint8)
    after = (view.used != view.exact) & (view.used != IGNORE)
    before = np.zeros_like(after)
    if view.given is not None:
        before = (view.given != view.exact) & (view.given != IGNORE)
    picture[before & after] = _WRONG
    picture[before & ~after] = _MENDED
    picture[after & ~before] = _SPOILT
    picture[(view.used == IGNORE) | (view.exact == IGNORE)] = _UNKNOWN
    return picture
