"""What closing objects gains, against exact shapes: python -m benchmarks.closing RUN [RUN ...] [OBJECT ...].

For each object (all, if none is named) of runs of generated scenes, as splats and as a mesh, open and closed: the IoU
of its whole silhouettes in the held-out views; the same from below, from eyes mirrored in the level plane through its
middle; chamfer, the mean of the two mean distances between its surface and the exact one, the underside too, in per
cent of its longest side; and, of meshes, whether they are watertight. Splats are where their median depth is, seen from
all around.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from beags_plugin.export import EXPORTERS
from beags_plugin.export.mesh import GlbExporter
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.surfaces.meshing import MadeMesh
from benchmarks.meshes import Drawn, chamfer, exact_points, is_closed, read_glb

ALL_AROUND = 14  # views of the depth of splats
PIXELS = 160  # of these, along a side
POINTS = 20_000  # at most, of these views together


@dataclass(frozen=True)
class OpenMesh(GlbExporter):
    """As glb, vertex-coloured, open also where objects are closed."""

    suffix: ClassVar[str] = "open.glb"
    texture: Any = "none"

    def made(self, item: ExportItem) -> MadeMesh:
        return super().made(replace(item, close=False))


@dataclass(frozen=True)
class ClosedMesh(GlbExporter):
    """As glb, vertex-coloured."""

    suffix: ClassVar[str] = "closed.glb"
    texture: Any = "none"


def measure(config_path: Path, objects: Sequence[str]) -> dict[str, np.ndarray]:
    """Print a row for each object of a run (all, if none is named); return their figures [objects, 4], by kind."""
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.export import export_run
    from beags_plugin.sample.families import FAMILIES
    from beags_plugin.splat_io.ply import read_ply
    from beags_plugin.surfaces.frames import Frame
    from beags_plugin.surfaces.mesh_options import MeshOptions
    from beags_plugin.system.reading.ply import read_vertices

    run = EvaluatedRun(config_path)
    sample = json.loads((run.stages["after"].config.data_path / "sample.json").read_text())
    things = {thing.name: thing for thing in FAMILIES[sample["family"]].scene(sample["seed"]).things}
    ids = {name: c for c, name in run.classes.items() if c and (not objects or name in objects)}
    if not ids:
        sys.exit(f"{run.name} has no object {' or '.join(objects)}: name one of {', '.join(run.classes.values())}.")
    found: dict[str, list[list[float]]] = {}
    for name, class_id in ids.items():
        with tempfile.TemporaryDirectory() as folder:
            (exported,) = export_run(
                config_path,
                [name],
                formats=("ply", "glb-open", "glb-closed"),
                output=Path(folder),
                closing=MeshOptions(),
            )
            splats, opened, closed = (file.path for file in exported.files)
            assert splats is not None and opened is not None and closed is not None
            surfels, _ = read_ply(splats)
            own = torch.from_numpy(read_vertices(splats)["invented"] == 0)
            meshes = read_glb(opened), read_glb(closed)
        matrix = torch.tensor(exported.to_run, dtype=torch.float64)
        scale = float(torch.linalg.det(matrix[:3, :3])) ** (1 / 3)
        frame = Frame(matrix[:3] / scale, scale)
        exact = exact_points(things[name])
        middle = (exact.min(axis=0) + exact.max(axis=0)) / 2
        held_out = [
            (frame.camera(view.camera), view.silhouettes[class_id].numpy())
            for view in run.views
            if view.silhouettes and class_id in view.silhouettes and view.silhouettes[class_id].any()
        ]
        below = [(camera, silhouette(things[name], camera)) for camera in (mirrored(c, middle) for c, _ in held_out)]
        painter = Painter(run.rasterizer, replace(run.settings, near=run.settings.near / scale, far=1e3))
        around = all_around(middle, float(np.ptp(exact, axis=0).max()))
        rows = {}
        for what, part in (("splats", surfels[own]), ("splats, closed", surfels)):
            covers = partial(painter.covers, part)
            distance = apart(painter.points(part, around), exact)
            rows[what] = [mean_iou(held_out, covers), mean_iou(below, covers), distance, np.nan]
        for what, mesh in zip(("mesh", "mesh, closed"), meshes, strict=True):
            covers = partial(covered, mesh)
            ious = mean_iou(held_out, covers), mean_iou(below, covers)
            rows[what] = [*ious, chamfer(mesh, exact), 100.0 * is_closed(mesh)]
        for what, row in rows.items():
            found.setdefault(what, []).append(row)
            print(f"| {run.name} {name} | {what} | {formatted(row)} |", flush=True)
    return {what: np.array(rows) for what, rows in found.items()}


@dataclass(frozen=True)
class Painter:
    """Draws splats, in the world of their file."""

    rasterizer: Any
    settings: Any

    def drawn(self, part, camera):
        from beags_plugin.rasterizers.rendering import surfel_inputs

        with torch.no_grad():
            return self.rasterizer.rasterize(surfel_inputs(part, camera), camera, self.settings, torch.zeros(3))

    def covers(self, part, camera) -> np.ndarray:
        return (self.drawn(part, camera).alpha > 0.5).numpy()

    def points(self, part, cameras) -> np.ndarray:
        """Return points [P, 3] of the surfaces that cameras see."""
        from beags_plugin.core.lifting import lift

        seen = []
        for camera in cameras:
            drawn = self.drawn(part, camera)
            there = (drawn.alpha > 0.5) & (drawn.median_depth > 0)
            seen.append(lift(drawn.median_depth, camera)[there].numpy())
        points = np.concatenate(seen)
        chosen = np.random.default_rng(0).permutation(len(points))[:POINTS]
        return points[np.sort(chosen)].astype(np.float64)


def apart(points: np.ndarray, exact: np.ndarray) -> float:
    """Return the mean of both mean distances, in per cent of the longest side of the exact points [P, 3]."""
    from scipy.spatial import KDTree

    there, back = KDTree(points).query(exact)[0].mean(), KDTree(exact).query(points)[0].mean()
    return float(100 * (there + back) / 2 / np.ptp(exact, axis=0).max())


def looking(eye: np.ndarray, at: np.ndarray, K: torch.Tensor, width: int, height: int):
    """Return a camera at a place [3] that looks at another."""
    from beags_plugin.core.cameras import Camera

    forward = (at - eye) / np.linalg.norm(at - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(forward, right), forward]
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return Camera(torch.from_numpy(viewmat).float(), K.float(), width, height)


def mirrored(camera, middle: np.ndarray):
    """Return a camera as far below a place as another is above it, which looks there."""
    eye = camera.center.double().numpy() * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * middle[2]]
    return looking(eye, middle, camera.K, camera.width, camera.height)


def all_around(middle: np.ndarray, side: float) -> list:
    """Return cameras spread evenly over a sphere around a thing (a Fibonacci lattice)."""
    index = np.arange(ALL_AROUND) + 0.5
    z, turn = 1 - 2 * index / ALL_AROUND, np.pi * (1 + 5**0.5) * index
    ways = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    K = torch.tensor([[1.8 * PIXELS, 0, PIXELS / 2], [0, 1.8 * PIXELS, PIXELS / 2], [0, 0, 1.0]])
    return [looking(middle + 3.5 * side * way, middle, K, PIXELS, PIXELS) for way in ways]


def rays(camera) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays through the middles of pixels start [1, 3], and their directions [P, 3]."""
    from beags_plugin.core.lifting import pixel_rays

    ways = pixel_rays(camera, torch.zeros(1)).reshape(-1, 3) @ camera.rotation.float()
    return camera.center.double().numpy()[None], ways.double().numpy()


def silhouette(thing, camera) -> np.ndarray:
    """Return [H, W] bool, the exact silhouette of a thing."""
    starts, ways = rays(camera)
    hit = thing.solid.first_hit((starts - thing.position) @ thing.rotation, ways @ thing.rotation)
    return np.isfinite(hit).reshape(camera.height, camera.width)


def covered(mesh: Drawn, camera) -> np.ndarray:
    """Return [H, W] bool, the silhouette of a mesh."""
    import open3d

    starts, ways = rays(camera)
    both = np.concatenate([np.broadcast_to(starts, ways.shape), ways], axis=1).astype(np.float32)
    hit = mesh.caster(mesh.places).cast_rays(open3d.core.Tensor(both))["t_hit"].numpy()
    return np.isfinite(hit).reshape(camera.height, camera.width)


def mean_iou(views: Sequence[tuple], covers) -> float:
    """Return the mean IoU in per cent of exact silhouettes and what covers a camera's pixels."""
    shares = []
    for camera, exact in views:
        mine = covers(camera)
        shares.append(100.0 * (mine & exact).sum() / max((mine | exact).sum(), 1))
    return float(np.mean(shares))


def formatted(row) -> str:
    """Return a row of the table."""
    return " | ".join(f"{value:.2f}" for value in row)


def main() -> None:
    """Measure the runs that are named."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    EXPORTERS.register("glb-open", "benchmarks.closing:OpenMesh")
    EXPORTERS.register("glb-closed", "benchmarks.closing:ClosedMesh")
    print("| scene, object | as | IoU % | IoU from below % | chamfer % | watertight % |")
    print("| --- | --- | --- | --- | --- | --- |", flush=True)
    every: dict[str, list[np.ndarray]] = {}
    runs = [path for path in map(Path, sys.argv[1:]) if path.exists()]
    objects = [name for name in sys.argv[1:] if not Path(name).exists()]
    if not runs:
        sys.exit(f"there is no run {objects[0]!r}: name its folder or its config.yml.")
    for path in runs:
        for what, rows in measure(path if path.is_file() else path / "config.yml", objects).items():
            every.setdefault(what, []).append(rows)
    for what, parts in every.items():
        print(f"| mean of {sum(map(len, parts))} objects | {what} | {formatted(np.concatenate(parts).mean(axis=0))} |")


if __name__ == "__main__":
    main()
