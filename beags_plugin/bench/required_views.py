"""What the views of a run have no use for: bands of the colour, objects and points that are out of view."""

from __future__ import annotations

from dataclasses import replace

import torch

from beags_plugin.bench.required_rows import Row, Scene, draw, in_turn, mean_psnr
from beags_plugin.core.lifting import lift
from beags_plugin.core.sh_resolution import inside, seen_shares, with_degree
from beags_plugin.extraction.select import select_class
from beags_plugin.preparation.fewer_bands import changes_of_fewer_bands
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth, surfel_inputs

_POINTS = 500  # of a view that are looked for in the others


def bands(scene: Scene) -> list[Row]:
    """Coefficients of the colour that no view tells apart, and what the base loses with fewer bands."""
    surfels, cameras = scene.base, [view.camera for view in scene.train]
    degree = surfels.sh_degree
    share, degrees = seen_shares(surfels.means, cameras, degree)
    count = surfels.sh.numel()
    rows = [Row("coefficients of the colour that no view tells apart", "coefficients", count, share * count)]
    for band in range(1, degree + 1):
        told = float(degrees[band + 1 :].sum()) * len(surfels)
        rows.append(Row(f"Gaussians whose views do not resolve degree {band}", "Gaussians", len(surfels), told))
    whole = [mean_psnr(draw(scene, surfels, views), views) for views in (scene.train, scene.test)]
    found = changes_of_fewer_bands(surfels, cameras, scene.rasterizer, scene.settings)
    for band, (fewer, change) in enumerate(found):
        times, _ = in_turn(lambda: draw(scene, surfels), lambda part=fewer: draw(scene, part))
        bare = with_degree(surfels, [], band)  # the bands left out, nothing in their stead
        losses = {
            "training views": whole[0] - mean_psnr(draw(scene, fewer, scene.train), scene.train),
            "held-out views": whole[1] - mean_psnr(draw(scene, fewer), scene.test),
            "training views, nothing in their stead": whole[0] - mean_psnr(draw(scene, bare, scene.train), scene.train),
        }
        size = 4.0 * fewer.sh.numel()
        named = f"bands above degree {band}, RMS change {change:.5f}"
        for where, loss in losses.items():
            row = Row(f"{named}: {where}", "bytes", 4.0 * count, size, measure="PSNR, dB", difference=loss)
            timed = {"timed": "drawing held-out views", "seconds_whole": times[0], "seconds_needed": times[1]}
            rows.append(replace(row, **timed) if where == "held-out views" else row)
    return rows


def objects(scene: Scene) -> list[Row]:
    """Drawings of one object in held-out views that see nothing of it."""
    if scene.class_ids is None:
        return []
    settings = replace(scene.settings, geometry=False, distortion=False)
    present = [class_id for class_id in torch.unique(scene.class_ids).tolist() if class_id != 0]
    parts = [select_class(scene.refined, scene.class_ids, class_id)[0] for class_id in present]
    pairs = [(part, view.camera) for part in parts for view in scene.test]

    def run(part, camera) -> bool:
        inputs = surfel_inputs(part, camera)
        return bool(scene.rasterizer.rasterize(inputs, camera, settings, torch.zeros(3)).visible.any())

    with torch.no_grad():
        shown = [pair for pair in pairs if run(*pair)]
        times, _ = in_turn(lambda: [run(*pair) for pair in pairs], lambda: [run(*pair) for pair in shown])
    what = "objects alone in held-out views"
    return [Row(what, "drawings", len(pairs), len(shown), "drawing them", times[0], times[1])]


def pairs(scene: Scene) -> list[Row]:
    """Pairs of training views, one of which sees no point of the other: nothing there to reproject."""
    points = []
    for view in scene.train:
        with torch.no_grad():
            drawn = scene.rasterizer.rasterize(
                geometry_inputs(scene.base), view.camera, scene.settings, scene.base.means.new_zeros(3)
            )
        depth = surface_depth(drawn, "median")
        found = lift(depth, view.camera)[depth > 0]
        points.append(found[:: max(1, len(found) // _POINTS)])
    shared = sum(bool(inside(part, view.camera).any()) for part in points for view in scene.train)
    return [Row("pairs of views in reprojection", "pairs", len(scene.train) ** 2, shared)]
