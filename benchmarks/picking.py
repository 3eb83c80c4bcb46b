"""Quality and speed of the cut by prompts: python -m benchmarks.picking clicks RUN [RUN ...] | growth RUN | speed [N].

clicks: for each object of the data of trained runs, three points on it and two beside it are placed in the training
view that shows most of it, by its exact masks (``placed``); the cut is drawn into the held-out views, and its mean IoU
with their exact masks printed: with these points alone; together, where the points on the other objects count as points
beside this one, as in a file that prompts all; and the limit, Gaussians of the class that most of their light falls on
in all exact training masks, which is about as good as masks drawn from these Gaussians get. Then the IoU of each object
alone and together. growth: the mean IoU of the Gaussians themselves with that limit, of cuts by one point on and none
beside, and by all, as they are, after steps of growing and shrinking, and with a ring of neighbours more or less.
speed: the time of the parts of a cut of N Gaussians (100,000).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

ON, BESIDE = 3, 2
CORE = 3.0  # pixels: least distance of a further point on the object from its outline, if it is that thick
RING = 8.0  # pixels: a point beside lies at most so far from the outline,
CLEAR = 3.0  # and if possible so far inside the thing that it is on
SPEED_GAUSSIANS = 100_000
Pixels = list[tuple[int, int]]


def placed(ids: np.ndarray, class_id: int) -> tuple[Pixels, Pixels]:
    """Return pixels (row, column) on an object and beside it, by a fixed rule; ids: [H, W] exact class ids.

    On it: the pixel farthest from the outline, then those farthest from the points so far, well inside. Beside it: one
    on each of the two things with the most pixels about the outline, or both on one, far from each other.
    """
    from scipy.ndimage import distance_transform_edt

    def depth(mask: np.ndarray) -> np.ndarray:
        return np.asarray(distance_transform_edt(np.pad(mask, 1)))[1:-1, 1:-1]

    def farthest(among: np.ndarray, pixels: Pixels) -> tuple[int, int]:
        rows, columns = np.nonzero(among)
        apart = np.min([(rows - row) ** 2 + (columns - column) ** 2 for row, column in pixels], axis=0)
        best = int(np.argmax(apart))
        return int(rows[best]), int(columns[best])

    own = ids == class_id
    inside = depth(own)
    row, column = np.unravel_index(int(np.argmax(inside)), own.shape)
    on = [(int(row), int(column))]
    while len(on) < ON:
        on.append(farthest(inside >= min(CORE, 0.7 * inside.max()), on))
    away = np.asarray(distance_transform_edt(~own))
    ring = (away > 0) & (away <= RING) & (ids != 65535)
    things, counts = np.unique(ids[ring], return_counts=True)
    chosen = things[np.argsort(-counts, kind="stable")][:BESIDE].tolist()
    beside: Pixels = []
    for thing in chosen * (BESIDE if len(chosen) == 1 else 1):
        clear = np.where(ring, np.minimum(depth(ids == thing), CLEAR), 0.0)
        beside.append(farthest(clear == clear.max(), beside or on[:1]))
    return on, beside


def clicks(config_path: Path) -> None:
    """Print a row of a table for a run: mean IoU, and that of each object."""
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.picking.cutter import Cutter
    from beags_plugin.system.errors import UserError

    run = EvaluatedRun(config_path)
    surfels, cameras = run.stages["after"].surfels(), run.views.cameras("train")
    exact = exact_masks(run)
    objects = [class_id for class_id in run.classes if class_id]
    cutter = Cutter(surfels, cameras, run.rasterizer, run.settings)
    chosen = [int(np.argmax([(ids == class_id).sum() for ids in exact])) for class_id in objects]
    points = [placed(exact[view], class_id) for view, class_id in zip(chosen, objects, strict=True)]

    def solved(index: int, together: bool) -> Tensor:
        own = [marked(cameras[chosen[index]], *points[index])]
        others = [
            replace(marked(cameras[view], [], on), of_others=True)
            for other, (view, (on, _)) in enumerate(zip(chosen, points, strict=True))
            if together and other != index
        ]
        try:
            return cutter.solve(own + others)
        except UserError as error:
            print(f"{config_path}: {run.classes[objects[index]]}: {error}", file=sys.stderr)
            return torch.zeros(len(surfels), dtype=torch.bool)

    alone, together = ([solved(i, other) for i in range(len(objects))] for other in (False, True))
    best = owners(run, exact)
    sets = alone, together, [best == class_id for class_id in objects]
    one, all_, limit = (overlaps(run, surfels, members, objects) for members in sets)
    each = ", ".join(f"{run.classes[c]} {a:.1f} {b:.1f}" for c, a, b in zip(objects, one, all_, strict=True))
    print(f"| {run.name} | {np.mean(one):.1f} | {np.mean(all_):.1f} | {np.mean(limit):.1f} | {each} |", flush=True)


def exact_masks(run) -> list[np.ndarray]:
    """Return the exact masks of a run's training views, [H, W] int32."""
    from beags_plugin.labels.classes import read_id_mask

    photos = run.views.manager.train_dataset.image_filenames
    return [read_id_mask(p.parents[1] / f"ground_truth/masks/{p.stem}.png").astype(np.int32) for p in photos]


def owners(run, exact: Sequence[np.ndarray]) -> Tensor:
    """Return the class on which most of each Gaussian's light falls in exact masks, [N]."""
    from beags_plugin.assignment.contributions import contributions

    surfels, tables = run.stages["after"].surfels(), [torch.from_numpy(ids) for ids in exact]
    classes = max(int(ids[ids != 65535].max()) for ids in exact) + 1
    return contributions(
        surfels, run.views.cameras("train"), tables, run.rasterizer, run.settings, classes
    ).largest()[0]  # fmt: skip


def growth(config_path: Path) -> None:
    """Print the mean IoU in per cent for each way to change a cut's size; a base without classes will do."""
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.picking.cutter import Cutter
    from beags_plugin.picking.picks import GROWTH

    run = EvaluatedRun(config_path)
    surfels, cameras, exact = run.stages["after"].surfels(), run.views.cameras("train"), exact_masks(run)
    best, cutter = owners(run, exact).cpu(), Cutter(surfels, cameras, run.rasterizer, run.settings)
    found: dict[str, list[float]] = {}
    for class_id in sorted({int(each) for ids in exact for each in np.unique(ids)} - {0, 65535}):
        view, truth = int(np.argmax([(ids == class_id).sum() for ids in exact])), best == class_id
        on, beside = placed(exact[view], class_id)
        for points in ((on[:1], []), (on, beside)):
            marks = [marked(cameras[view], *points)]
            cuts = {f"{steps:+d} steps": cutter.solve(marks, growth=GROWTH * steps) for steps in (-2, -1, 0, 1, 2, 4)}
            cuts["a ring less"], cuts["a ring more"] = ringed(cutter, cuts["+0 steps"])
            for name, members in cuts.items():
                found.setdefault(name, []).append(100 * float((members & truth).sum() / (members | truth).sum()))
    print(f"{len(surfels)} Gaussians, {len(found['+0 steps'])} cuts")
    for name, values in found.items():
        print(f"| {name} | {np.mean(values):.1f} |")


def ringed(cutter, members: Tensor) -> tuple[Tensor, Tensor]:
    """Return members [N] bool without those that are linked to others, and with all that are linked to them."""
    graph = cutter._graph
    own = members.numpy()[graph.nodes]
    less, more = own.copy(), own.copy()
    for one, other in ((graph.first, graph.second), (graph.second, graph.first)):
        less[one[~own[other]]] = False
        more[one[own[other]]] = True
    return torch.from_numpy(less[graph.nearest]), torch.from_numpy(more[graph.nearest])


def marked(camera, on: Pixels, beside: Pixels):
    """Return the marks of pixels in a view, three pixels wide."""
    from beags_plugin.labels.class_ids import IGNORE
    from beags_plugin.picking.cutter import ViewMarks

    numbers = torch.full((camera.height, camera.width), IGNORE, dtype=torch.int32)
    for number, (row, column) in enumerate([*on, *beside]):
        numbers[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2] = number
    return ViewMarks("view", camera, numbers, (True,) * len(on) + (False,) * len(beside))


def overlaps(run, surfels, members: Sequence[Tensor], objects: Sequence[int]) -> list[float]:
    """Return the mean IoU in per cent over the held-out views of masks drawn from members, each [N] bool."""
    from beags_plugin.rasterizers.rendering import draw_features, geometry_inputs

    inputs = geometry_inputs(surfels)
    features = torch.stack(list(members), dim=1).to(inputs.means)
    found: dict[int, list[float]] = {class_id: [] for class_id in objects}
    for view in run.views:
        with torch.no_grad():
            light = draw_features(run.rasterizer, inputs, features, view.camera, run.settings)
        known = view.visible != 65535
        for index, class_id in enumerate(objects):
            drawn, truth = (light[..., index] > 0.5) & known, view.visible == class_id
            if truth.any():
                found[class_id].append(100 * float((drawn & truth).sum() / (drawn | truth).sum()))
    return [float(np.mean(found[class_id])) for class_id in objects]


def speed(gaussians: int) -> None:
    """Print wall and processor time of the parts of a cut, with one thread and with two."""
    import scipy.sparse.csgraph
    import scipy.spatial  # noqa: F401  (a second of reading files, once a process)

    from beags_plugin.picking.cutter import Cutter
    from beags_plugin.rasterizers import make_rasterizer
    from benchmarks.clock import Seconds
    from benchmarks.scaling_scene import SETTINGS, Sizes, make_scene

    rasterizer = make_rasterizer("native")
    scene = make_scene(Sizes(classes=8, views=24, gaussians=gaussians, pixels=76_800), rasterizer)
    ids = scene.labels[0].numpy()
    objects, counts = np.unique(ids[(ids != 0) & (ids != 65535)], return_counts=True)
    on, beside = placed(ids, int(objects[np.argmax(counts)]))
    for threads in (1, 2):
        torch.set_num_threads(threads)
        began = Seconds.now()
        cutter = Cutter(scene.surfels, scene.cameras, rasterizer, replace(SETTINGS, geometry=False))
        print(f"{len(scene.surfels)} Gaussians, {threads} threads: made once {report(Seconds.now() - began)}")
        for name, points in (("first cut", beside[:1]), ("after another point", beside)):
            began = Seconds.now()
            members = cutter.solve([marked(scene.cameras[0], on, points)])
            print(f"  {name} {report(Seconds.now() - began)}, {int(members.sum())} Gaussians")


def report(seconds) -> str:
    """Return both times of ``benchmarks.clock.Seconds``."""
    return f"{seconds.wall:.2f} s ({seconds.cpu:.2f} s of processor time)"


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["clicks", *runs] if runs:
            print("| scene | alone | together | limit | objects |\n|---|---|---|---|---|")
            for each in runs:
                clicks(Path(each))
        case ["growth", run]:
            growth(Path(run))
        case ["speed", *size] if len(size) < 2:
            speed(int(size[0]) if size else SPEED_GAUSSIANS)
        case _:
            sys.exit(__doc__)
