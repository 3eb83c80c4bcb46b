"""What leaving out Gaussians that do not belong changes in scores: python -m benchmarks.cleaning RUN [RUN ...].

For each object of trained runs with masks: how many of its Gaussians ``beags extract`` leaves out, and the IoU and
BIoU of its extracted masks in the held-out views, their means and the BIoU of its worst view, before and after. Each is
of the same held-out views, by the default protocol.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

WORSE = 0.2  # points of mean BIoU that no object may lose


@dataclass(frozen=True)
class Change:
    """An object's Gaussians, those left out, and (before, after) in per cent: IoU, BIoU, BIoU of the worst view."""

    run: str
    name: str
    gaussians: int
    dropped: int
    why: str
    iou: tuple[float, float]
    biou: tuple[float, float]
    worst: tuple[float, float]

    def row(self) -> str:
        scores = " | ".join(f"{before:.2f}, {after:.2f}" for before, after in (self.iou, self.biou, self.worst))
        return f"| {self.run} {self.name} | {self.gaussians} | {self.dropped} | {scores} | {self.why} |"


def measure(config_path: Path) -> list[Change]:
    """Return what cleaning changes for each object of a run that the held-out views show."""
    from beags_plugin.core.membership import Membership
    from beags_plugin.core.select import select_class
    from beags_plugin.evaluation.metrics import MaskMetrics
    from beags_plugin.evaluation.run_metrics import evaluate_scene
    from beags_plugin.objects.clean import cleaner_of
    from beags_plugin.objects.evaluate import EvaluatedRun

    run = EvaluatedRun(config_path)
    scene = run.stages["after"]
    surfels, members = scene.surfels().detach(), scene.members
    cleaner = cleaner_of(run.run)
    kept, counts = {}, {}
    for class_id in run.classes:
        if class_id and class_id in members.present():
            part, index = select_class(surfels, members, class_id)
            _, kept[class_id], left_out = cleaner.clean(part, index, class_id)
            counts[class_id] = len(index), len(index) - len(kept[class_id]), str(left_out)
    cleaned = Membership(members.class_ids, kept)
    found = []
    for each in (members, cleaned):
        metrics = evaluate_scene(
            surfels, each, run.rasterizer, run.settings, run.views, run.classes, complete=False
        ).masks
        scores: dict[int, list[tuple[float, float]]] = {}
        for record in metrics:
            of_mask = record.metrics
            if record.kind == "extracted" and isinstance(of_mask, MaskMetrics) and of_mask.iou is not None:
                scores.setdefault(record.class_id, []).append((of_mask.iou, of_mask.biou or 0.0))
        found.append({c: 100 * np.array(rows) for c, rows in scores.items()})
    before, after = found
    return [
        Change(
            run.name,
            run.classes[c],
            *counts[c],
            iou=(before[c][:, 0].mean(), after[c][:, 0].mean()),
            biou=(before[c][:, 1].mean(), after[c][:, 1].mean()),
            worst=(before[c][:, 1].min(), after[c][:, 1].min()),
        )
        for c in sorted(counts)
        if c in before and c in after
    ]


def summary(changes: list[Change]) -> str:
    """Return the last lines: means over all objects, how many change, and whether any loses more than it may."""
    worst = max(changes, key=lambda change: change.biou[0] - change.biou[1])
    lost = max(changes, key=lambda change: change.worst[0] - change.worst[1])
    iou, biou, view = (np.mean([getattr(c, what) for c in changes], axis=0) for what in ("iou", "biou", "worst"))
    missed = [f"{c.run} {c.name}" for c in changes if c.biou[0] - c.biou[1] > WORSE]
    gain, lose = (sum(sign * (c.biou[1] - c.biou[0]) > 0 for c in changes) for sign in (1, -1))
    return "\n".join(
        [
            f"mean of {len(changes)} objects, before, after: IoU {iou[0]:.2f}, {iou[1]:.2f}; BIoU {biou[0]:.2f}, "
            f"{biou[1]:.2f}; worst view's BIoU {view[0]:.2f}, {view[1]:.2f}",
            f"{sum(c.dropped for c in changes)} of {sum(c.gaussians for c in changes)} Gaussians left out, of "
            f"{sum(c.dropped > 0 for c in changes)} objects",
            f"{gain} objects gain, {lose} lose; most by {worst.biou[0] - worst.biou[1]:.2f} points of BIoU "
            f"({worst.run} {worst.name}), in a worst view by {lost.worst[0] - lost.worst[1]:.2f} "
            f"({lost.run} {lost.name})",
            f"more than {WORSE} points worse: {', '.join(missed) or 'none'}",
        ]
    )


def main() -> None:
    """Measure the runs that are named."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    print("| scene, object | Gaussians | left out | IoU % | BIoU % | worst view's BIoU % | why |")
    print("| --- | --- | --- | --- | --- | --- | --- |", flush=True)
    changes: list[Change] = []
    with torch.no_grad():
        for path in map(Path, sys.argv[1:]):
            found = measure(path if path.is_file() else path / "config.yml")
            print(*(change.row() for change in found), sep="\n", flush=True)
            changes += found
    print(summary(changes))


if __name__ == "__main__":
    main()
