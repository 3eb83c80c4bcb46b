"""Meshes of trained runs against photos and exact shapes: python -m beags_benchmarks.studies.meshes RUN [OBJECT ...].

Each object (all, if none is named) of a run is exported as a mesh with a texture, with colours of vertices, and closed,
and rendered into the held-out views by four rays a pixel. PSNR is the mean over views, over pixels well inside the
object's masks (exact in generated scenes) that both mesh and splats cover. Covered is the share of the masks' pixels
that the mesh covers. Chamfer is the mean of the two mean distances between mesh and exact surface, including the
underside, in per cent of the object's longest side; it is nan for captures, whose shapes are unknown.

With ``--one-colour``: PSNR of the splats alone, unchanged and with one colour from all sides. The latter is the bound
for textures where the photos' colours change with the view.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from beags_plugin.evaluation.metrics import psnr
from beags_plugin.export import EXPORTERS
from beags_plugin.export.mesh import GlbExporter

FEWEST = 50  # pixels that a scored view needs
RAYS, DISTANCES = 200_000, 20_000  # rays at the exact surface, and points on a mesh
_TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True)
class Drawn:
    """A mesh of a .glb: places [V, 3], z up, faces [F, 3]; sRGB colours by vertex [V, 3] or by uv [V, 2] and image."""

    places: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None
    uv: np.ndarray | None
    image: np.ndarray | None

    def caster(self, places: np.ndarray) -> Any:
        import open3d

        scene, tensor = open3d.t.geometry.RaycastingScene(), open3d.core.Tensor
        scene.add_triangles(tensor(places.astype(np.float32)), tensor(self.faces.astype(np.uint32)))
        return scene

    def seen_by(self, camera, to_run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the picture [H, W, 3] and the pixels that the mesh covers [H, W], by 2 x 2 rays for each pixel."""
        import open3d

        from beags_plugin.core.cameras import Camera
        from beags_plugin.core.lifting import pixel_rays

        fine = Camera(
            camera.viewmat, camera.K * torch.tensor([[2.0], [2.0], [1.0]]), 2 * camera.width, 2 * camera.height
        )
        ways = (pixel_rays(fine, torch.zeros(1)).reshape(-1, 3) @ camera.rotation.float()).numpy()
        rays = np.concatenate([np.broadcast_to(camera.center.float().numpy(), ways.shape), ways], axis=1)
        places = self.places @ to_run[:3, :3].T + to_run[:3, 3]
        hit = self.caster(places).cast_rays(open3d.core.Tensor(rays.astype(np.float32)))
        there = np.isfinite(hit["t_hit"].numpy())
        face, (u, v) = hit["primitive_ids"].numpy()[there], hit["primitive_uvs"].numpy()[there].T
        weights = np.stack([1 - u - v, u, v], axis=1)

        def at(values: np.ndarray) -> np.ndarray:
            return np.einsum("pc,pcd->pd", weights, values[self.faces[face]])

        colors = np.zeros((len(there), 3))
        if self.uv is not None and self.image is not None:
            colors[there] = looked_up(self.image, at(self.uv))
        elif self.colors is not None:
            colors[there] = at(self.colors)
        shape = (camera.height, 2, camera.width, 2)
        return colors.reshape(*shape, 3).mean(axis=(1, 3)), there.reshape(shape).all(axis=(1, 3))


def looked_up(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the picture's colours [P, 3] at uv [P, 2], interpolated between texels."""
    from scipy.ndimage import map_coordinates

    at = (uv * [image.shape[1], image.shape[0]] - 0.5)[:, ::-1].T
    return np.stack([map_coordinates(image[..., c], at, order=1, mode="nearest") for c in range(3)], axis=1)


def read_glb(path: Path) -> Drawn:
    """Read a .glb of ``beags export`` by the standard."""
    from PIL import Image

    from beags_plugin.surfaces.color import srgb_from_linear

    raw = path.read_bytes()
    length = int.from_bytes(raw[12:16], "little")
    content, binary = json.loads(raw[20 : 20 + length]), raw[28 + length :]

    def view(number: int) -> bytes:
        part = content["bufferViews"][number]
        return binary[part["byteOffset"] : part["byteOffset"] + part["byteLength"]]

    def accessor(number: int) -> np.ndarray:
        part = content["accessors"][number]
        return np.frombuffer(view(part["bufferView"]), _TYPES[part["componentType"]]).reshape(-1, _WIDTHS[part["type"]])

    primitive = content["meshes"][0]["primitives"][0]
    named = primitive["attributes"]
    places = accessor(named["POSITION"])[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    faces = accessor(primitive["indices"]).reshape(-1, 3).astype(np.int64)
    if "TEXCOORD_0" not in named:
        return Drawn(places, faces, srgb_from_linear(accessor(named["COLOR_0"])[:, :3] / 65535), None, None)
    image = np.asarray(Image.open(BytesIO(view(content["images"][0]["bufferView"]))), np.float64) / 255
    return Drawn(places, faces, None, accessor(named["TEXCOORD_0"]).astype(np.float64), image)


def exact_points(thing) -> np.ndarray:
    """Return points [P, 3] over the whole exact surface of an object of a generated scene, world."""
    generator = np.random.default_rng(0)
    ways = generator.normal(size=(RAYS, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    aims = generator.normal(size=(RAYS, 3))
    aims *= thing.solid.bound * generator.random((RAYS, 1)) ** (1 / 3) / np.linalg.norm(aims, axis=1, keepdims=True)
    starts = 3 * thing.solid.bound * ways
    t = thing.solid.first_hit(starts, aims - starts)
    local = (starts + (aims - starts) * np.where(np.isfinite(t), t, 0)[:, None])[np.isfinite(t)]
    _, first = np.unique(np.floor(local / (thing.solid.bound / 60)), axis=0, return_index=True)  # evenly
    return local[np.sort(first)] @ thing.rotation.T + thing.position


def chamfer(mesh: Drawn, exact: np.ndarray) -> float:
    """Return the mean of both mean distances in per cent of the longest side of the exact points [P, 3]."""
    import open3d
    import trimesh
    from scipy.spatial import KDTree

    side = np.ptp(exact, axis=0).max()
    there = mesh.caster(mesh.places).compute_distance(open3d.core.Tensor(exact.astype(np.float32))).numpy()
    surface = trimesh.Trimesh(mesh.places, mesh.faces, process=False)
    points = trimesh.sample.sample_surface(surface, DISTANCES, seed=0)[0]
    back, _ = KDTree(exact).query(np.asarray(points))
    return float(100 * (there.mean() + back.mean()) / 2 / side)


@dataclass(frozen=True)
class VertexColors(GlbExporter):
    """A glb without texture; a separate exporter, so that one export renders the depth of an object once."""

    suffix: ClassVar[str] = "colors.glb"
    texture: Any = "none"


@dataclass(frozen=True)
class Closed(GlbExporter):
    """A closed glb."""

    suffix: ClassVar[str] = "closed.glb"
    closes: ClassVar[bool] = True


VARIANTS = {"glb": "texture", "glb-colors": "vertex colours", "glb-closed": "texture, closed"}


def measure(config_path: Path, objects: Sequence[str]) -> None:
    """Print rows of a table for objects of a run, or for all if none is named."""
    from beags_plugin.core.select import select_class
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.export import export_run
    from beags_plugin.sample import FAMILIES

    EXPORTERS.register("glb-colors", "beags_benchmarks.studies.meshes:VertexColors")
    EXPORTERS.register("glb-closed", "beags_benchmarks.studies.meshes:Closed")
    run = EvaluatedRun(config_path)
    scene = run.stages["after"]
    things = {}
    if (described := scene.config.data_path / "sample.json").exists():
        sample = json.loads(described.read_text())
        things = {thing.name: thing for thing in FAMILIES.get(sample["family"]).scene(sample["seed"]).things}
    ids = {name: class_id for class_id, name in run.classes.items() if class_id}
    by_variant: dict[str, list[list[float]]] = {label: [] for label in VARIANTS}
    for name in objects or ids:
        part, _ = select_class(scene.surfels(), scene.members, ids[name])
        views = [scored(run, part, view, ids[name]) for view in run.views]
        exact = exact_points(things[name]) if things else None
        with tempfile.TemporaryDirectory() as folder:
            (exported,) = export_run(config_path, [name], formats=tuple(VARIANTS), output=Path(folder))
            for file in exported.files:
                assert file.path is not None
                row = figures(read_glb(file.path), np.array(exported.to_run), views, exact)
                row.append(file.path.stat().st_size / 1e6)
                by_variant[file.format].append(row)
                print(f"| {run.name} {name} | {VARIANTS[file.format]} | {formatted(row)} |", flush=True)
                print(file.facts, file=sys.stderr)
    for label, rows in by_variant.items():
        print(f"| {run.name}, mean | {VARIANTS[label]} | {formatted(np.mean(rows, axis=0))} |", flush=True)


def measure_one_colour(config_path: Path, objects: Sequence[str]) -> None:
    """Print PSNR of objects' splats in held-out views, unchanged and with one colour each."""
    from beags_plugin.core.select import select_class
    from beags_plugin.export.page_colors import seen_colors
    from beags_plugin.objects.evaluate import EvaluatedRun

    run = EvaluatedRun(config_path)
    scene = run.stages["after"]
    training = run.run.viewpoints
    ids = {name: class_id for class_id, name in run.classes.items() if class_id}
    for name in objects or ids:
        part, _ = select_class(scene.surfels(), scene.members, ids[name])
        kinds = part, seen_colors(part, training, lambda done: None).surfels
        rows = []
        for view in run.views:
            renderings = [scored(run, kind, view, ids[name]) for kind in kinds]
            both = renderings[0].inside & renderings[0].solid
            if both.sum() >= FEWEST:
                rows.append([psnr(each.splats[both], each.photo[both]) for each in renderings])
        print("| {} {} | {:.2f} | {:.2f} |".format(run.name, name, *np.mean(rows, axis=0)), flush=True)


@dataclass(frozen=True)
class Scored:
    """A held-out view: photo [H, W, 3], pixels well inside an object's exact mask [H, W], and the object's splats
    rendered alone: colours [H, W, 3] and solid pixels [H, W]."""

    camera: Any
    photo: np.ndarray
    inside: np.ndarray
    splats: np.ndarray
    solid: np.ndarray


def scored(run, part, view, class_id: int) -> Scored:
    """Return the data of a held-out view for an object; part: its Gaussians."""
    from scipy.ndimage import binary_erosion

    from beags_plugin.labels.class_ids import resize_nearest
    from beags_plugin.rasterizers.rendering import surfel_inputs

    inputs = surfel_inputs(part.detach(), view.camera)
    render = run.rasterizer.rasterize(inputs, view.camera, run.settings, torch.zeros(3))
    alpha = render.alpha.numpy()
    color = np.clip(render.color.numpy() / np.maximum(alpha, 1e-3)[..., None], 0, 1)
    own = resize_nearest((view.visible == class_id).numpy(), view.camera.height, view.camera.width)
    inside = binary_erosion(own, np.ones((3, 3)))
    return Scored(view.camera, view.image.numpy(), inside, color, alpha > 0.5)


def figures(mesh: Drawn, to_run: np.ndarray, views: Sequence[Scored], exact: np.ndarray | None) -> list[float]:
    """Return a mesh's row without the size of its file; exact: points of the true surface, None if it is unknown."""
    mine, theirs, covered, of = [], [], 0, 0
    for view in views:
        picture, there = mesh.seen_by(view.camera, to_run)
        covered, of = covered + int((there & view.inside).sum()), of + int(view.inside.sum())
        both = view.inside & there & view.solid
        if both.sum() >= FEWEST:
            mine.append(psnr(picture[both], view.photo[both]))
            theirs.append(psnr(view.splats[both], view.photo[both]))
    closed = 100.0 * is_closed(mesh)
    means = float(np.mean(theirs)), float(np.mean(mine))
    distance = np.nan if exact is None else chamfer(mesh, exact)
    return [*means, 100 * covered / max(of, 1), distance, closed, len(mesh.faces)]


def is_closed(mesh: Drawn) -> bool:
    """Return whether every edge has two faces, after joining vertices at one place (seams)."""
    import trimesh

    return bool(trimesh.Trimesh(mesh.places, mesh.faces, process=True, merge_tex=True, merge_norm=True).is_watertight)


def formatted(row) -> str:
    """Return a row of the table."""
    splats, mine, covered, distance, closed, triangles, size = row
    return f"{splats:.2f} | {mine:.2f} | {covered:.1f} | {distance:.2f} | {closed:.0f} | {triangles:,.0f} | {size:.2f}"


def main() -> None:
    """Measure objects of a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("objects", nargs="*", metavar="OBJECT")
    parser.add_argument("--one-colour", action="store_true")
    options = parser.parse_args()
    path = options.run if options.run.is_file() else options.run / "config.yml"
    if options.one_colour:
        print("| scene, object | splats' PSNR | with one colour from all sides |\n| --- | --- | --- |", flush=True)
        return measure_one_colour(path, options.objects)
    print("| scene, object | mesh | splats' PSNR | its PSNR | covered % | chamfer % | closed % | triangles | MB |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |", flush=True)
    measure(path, options.objects)


if __name__ == "__main__":
    main()
