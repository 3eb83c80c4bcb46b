"""Meshes of a run on disk look like its objects: read by other programs' readers, drawn by ray casting from held-out
cameras in the frame of the input poses, and compared with the splats drawn in the run's own frame."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")
open3d = pytest.importorskip("open3d")
trimesh = pytest.importorskip("trimesh")

from covered_things import camera_of, covered, thing_called
from data_folders import quaternion, write_image
from run_folders import CLASSES, state_of

from beags_plugin.commands.cli import main
from beags_plugin.core.rotations import quat_product
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.objects.evaluate import EvaluatedRun
from beags_plugin.plugin.options.config import base_config
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.runs.write import write_run
from beags_plugin.sample.views import View, make_views
from beags_plugin.splat_io.frames import TRANSFORM_FILE

WIDTH, HEIGHT = 640, 480
OBJECTS = {class_id: name for class_id, name in CLASSES.items() if class_id}
LEAST_IOU, MOST_COLOR_ERROR = 0.95, 0.015  # IoU of silhouettes; mean error over pixels and channels, in 0..1


@dataclass(frozen=True)
class Picture:
    """silhouette: [H, W] bool. color: [H, W, 3], sRGB 0..1, where something is."""

    silhouette: np.ndarray
    color: np.ndarray

    def alike(self, other: Picture) -> bool:
        both = self.silhouette & other.silhouette
        iou = both.sum() / max((self.silhouette | other.silhouette).sum(), 1)
        return bool(iou > LEAST_IOU and np.abs(self.color - other.color)[both].mean() < MOST_COLOR_ERROR)


@dataclass(frozen=True)
class ReadMesh:
    """vertices: [V, 3]. faces: [F, 3]. colors: [V, 3], sRGB 0..1."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray

    def seen_by(self, view: View) -> Picture:
        """Cast a ray through the middle of each pixel; interpolate the colours of the face that it hits."""
        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        K = np.array([[view.focal, 0, view.cx], [0, view.focal, view.cy], [0, 0, 1]])
        world_to_camera = np.linalg.inv(view.camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
        hit = scene.cast_rays(scene.create_rays_pinhole(K, world_to_camera, view.width, view.height))
        there = np.isfinite(hit["t_hit"].numpy())
        face, (u, v) = hit["primitive_ids"].numpy()[there], hit["primitive_uvs"].numpy()[there].T
        corners = self.colors[self.faces[face]]
        color = np.zeros((*there.shape, 3))
        color[there] = np.einsum("ncd,nc->nd", corners, np.stack([1 - u - v, u, v], axis=1))
        return Picture(there, color)


def srgb_from_linear(values: np.ndarray) -> np.ndarray:
    """Return sRGB values (IEC 61966-2-1)."""
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)


def read(path: Path) -> ReadMesh:
    """Read a mesh, z up, by other projects' readers; trimesh gives no vertex colours where a .glb has a material."""
    if path.suffix == ".glb":
        glb = open3d.io.read_triangle_mesh(str(path))
        linear = np.asarray(glb.vertex_colors)
        z_up = np.asarray(glb.vertices)[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
        return ReadMesh(z_up, np.asarray(glb.triangles), srgb_from_linear(linear))
    obj = trimesh.load_mesh(path, process=False, maintain_order=True)
    return ReadMesh(np.array(obj.vertices), np.array(obj.faces), obj.visual.vertex_colors[:, :3] / 255.0)


@pytest.fixture(scope="module")
def views() -> list[View]:
    return make_views(2, WIDTH, HEIGHT, 28, 4)


@pytest.fixture(scope="module")
def config(tmp_path_factory, views) -> Path:
    """Return config.yml of a run of cup and box, whose data parser has turned, moved and scaled the world."""
    root = tmp_path_factory.mktemp("lab")
    lens = views[0]
    frames = [
        {"file_path": f"images/{view.name}.png", "transform_matrix": view.camera_to_world.tolist()} for view in views
    ]
    content = {
        "camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "cx": lens.cx, "cy": lens.cy,
        "fl_x": lens.focal, "fl_y": lens.focal, "frames": frames,
        **{f"{split}_filenames": [f"images/{view.name}.png" for view in views if view.split == split]
           for split in ("train", "test")},
        "val_filenames": [],
    }  # fmt: skip
    for view in views:
        write_image(root / f"data/images/{view.name}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    (root / "data/transforms.json").write_text(json.dumps(content))

    cameras = [camera_of(view) for view in views if view.split == "train"]
    parts = [covered(thing_called(name), cameras) for name in OBJECTS.values()]
    covers = Surfels(*(torch.cat([getattr(part, one.name) for part in parts]) for one in fields(Surfels)))
    ids = torch.cat([torch.full((len(part),), i, dtype=torch.int32) for i, part in zip(OBJECTS, parts, strict=True)])
    settings = base_config()
    settings.run_dir = root / "run"
    parser = settings.data_config.dataparser
    parser.data, parser.orientation_method = root / "data", "pca"  # the world's own z is up already
    parsed = parser.setup().get_dataparser_outputs("train")
    transform, scale = parsed.dataparser_transform.double(), parsed.dataparser_scale
    assert abs(scale - 1.0) > 0.1 and not torch.allclose(transform[:, :3], torch.eye(3, dtype=torch.float64), atol=0.1)
    settings.run_dir.mkdir()
    text = json.dumps({"transform": transform.tolist(), "scale": scale})
    (settings.run_dir / TRANSFORM_FILE).write_text(text)
    state = state_of(normalised(covers, transform, scale), ids)
    return write_run(settings, settings.run_dir, state, 199)


def normalised(surfels: Surfels, transform: torch.Tensor, scale: float) -> Surfels:
    """Return world Gaussians in nerfstudio's frame: scale (R p + t); transform: [3, 4], R and t."""
    rotation, shift = transform[:, :3], transform[:, 3]
    means = scale * (surfels.means.double() @ rotation.T + shift)
    turn = torch.from_numpy(quaternion(rotation.numpy()))
    quats = quat_product(turn.expand(len(means), 4), surfels.quats.double())
    return replace(
        surfels, means=means.float(), quats=quats.float(), log_scales=surfels.log_scales + float(np.log(scale))
    )


@pytest.fixture(scope="module")
def splats(config, views) -> dict[tuple[str, str], Picture]:
    """Render the run's own pictures of each object alone, by object and held-out view."""
    run = EvaluatedRun(config)
    scene = run.stages["after"]
    found = {}
    for view in run.views:
        for class_id, name in OBJECTS.items():
            part, _ = select_class(scene.surfels(), scene.members, class_id)
            inputs = surfel_inputs(part, view.camera)
            drawn = run.rasterizer.rasterize(inputs, view.camera, run.settings, torch.zeros(3))
            alpha = drawn.alpha.numpy()
            color = drawn.color.numpy() / np.maximum(alpha, 1e-3)[..., None]
            found[name, view.name] = Picture(alpha > 0.5, color)
    assert {view for _, view in found} == {view.name for view in views if view.split == "test"}
    return found


@pytest.fixture(scope="module")
def written(config, tmp_path_factory):
    """A function that writes meshes of both objects once, in the world's frame or centred; it returns their folder."""

    @cache
    def folder(frame: str, *formats: str) -> Path:
        found = tmp_path_factory.mktemp("meshes")
        main(["export", "--load-config", str(config), "--all", "--format", *formats, "--resolution", "96",
              "--truncation", "4", "--frame", frame, "--output", str(found)])  # fmt: skip
        return found

    return folder


@pytest.mark.parametrize("frame", ["world", "object"])
@pytest.mark.parametrize("suffix", ["glb", "obj"])
@pytest.mark.parametrize("name", OBJECTS.values())
@pytest.mark.slow("fuses and textures meshes as large as in use")
def test_a_mesh_looks_like_its_splats(written, splats, views, name, suffix, frame):
    folder = written(frame, "glb", "obj")
    mesh = read(folder / f"{name}.{suffix}")
    if frame == "object":
        objects = json.loads((folder / "manifest.json").read_text())["objects"]
        (center,) = (one["center"] for one in objects if one["name"] == name)
        assert not splats[name, views[4].name].alike(mesh.seen_by(views[4]))
        mesh = replace(mesh, vertices=mesh.vertices + center)
    for view in views:
        if view.split == "test":
            assert splats[name, view.name].silhouette.sum() > 300
            assert splats[name, view.name].alike(mesh.seen_by(view)), view.name


def _about_middle(mesh: ReadMesh, matrix: np.ndarray) -> ReadMesh:
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return replace(mesh, vertices=(mesh.vertices - middle) @ matrix.T + middle)


WRONG = {
    "another axis is up": lambda mesh: replace(mesh, vertices=mesh.vertices[:, [0, 2, 1]]),
    "mirrored where it stands": lambda mesh: _about_middle(mesh, np.diag([-1.0, 1.0, 1.0])),
    "5 % too large": lambda mesh: _about_middle(mesh, 1.05 * np.eye(3)),
    "moved by a twentieth": lambda mesh: replace(mesh, vertices=mesh.vertices + 0.05 * np.ptp(mesh.vertices, axis=0)),
    "half of it": lambda mesh: replace(mesh, faces=mesh.faces[::2]),
    "linear colours taken for sRGB": lambda mesh: replace(mesh, colors=mesh.colors**2.2),
    "red and blue exchanged": lambda mesh: replace(mesh, colors=mesh.colors[:, ::-1]),
    "colours of other vertices": lambda mesh: replace(mesh, colors=np.roll(mesh.colors, len(mesh.colors) // 3, axis=0)),
}


@pytest.mark.parametrize("mistake", WRONG)
def test_a_wrong_mesh_does_not(written, splats, views, mistake):
    """The comparison above would catch each mistake, in every view."""
    mesh = WRONG[mistake](read(written("world", "glb") / "cup.glb"))
    for view in views:
        if view.split == "test":
            assert not splats["cup", view.name].alike(mesh.seen_by(view)), view.name
