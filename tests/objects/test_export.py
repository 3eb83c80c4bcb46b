"""``beags export``: files for other programs, and their contents read back."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from random_surfels import SETTINGS, a_rotation, camera_at, drawn, psnr, random_surfels
from run_folders import CLASSES, discs, write_scene, write_trained

pytest.importorskip("nerfstudio")

from written_splats import read_ply

from beags_plugin.commands.cli import main
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.export import EXPORTERS
from beags_plugin.export.base import Exporter, make_exporter
from beags_plugin.importers.base import read_scene
from beags_plugin.objects import export
from beags_plugin.objects.export import export_run
from beags_plugin.objects.exported import ExportedFile
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.splat_io.files import whole_file
from beags_plugin.surfaces.frames import Frame, bounding_box
from beags_plugin.surfaces.item import ExportItem, Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.system.reading.ply import read_vertices


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return config.yml of a run whose data parser has turned and scaled the world."""
    root = tmp_path_factory.mktemp("lab")
    config = write_trained(root / "run", write_scene(root / "lab"))
    transform = torch.cat([a_rotation(3), torch.tensor([[0.4], [-0.2], [0.1]], dtype=torch.float64)], dim=1)
    (root / "run/dataparser_transforms.json").write_text(json.dumps({"transform": transform.tolist(), "scale": 0.5}))
    return config


def world_frame(config) -> Frame:
    content = json.loads((config.parent / "dataparser_transforms.json").read_text())
    return Frame(torch.tensor(content["transform"], dtype=torch.float64), content["scale"])


def test_a_camera_moves_with_the_frame():
    """In another frame, with its camera moved along, the scene looks the same, and its depths are scaled."""
    surfels, _ = discs()
    rotation, shift = a_rotation(4), torch.tensor([[0.3], [0.1], [-0.2]], dtype=torch.float64)
    frame = Frame(torch.cat([rotation, shift], dim=1), 0.4).centred(torch.tensor([1.0, 2.0, 3.0]))
    view = Viewpoints([camera_at((2.0, 1.0, 1.5))], make_rasterizer("auto"), SETTINGS)
    moved = frame.views(view)
    there = frame.surfels(surfels)
    before, after = drawn(surfels, view.cameras[0]), drawn(there, moved.cameras[0], moved.settings)
    assert before.min() < 0.5 and psnr(before, after) > 60
    assert moved.settings.far == pytest.approx(250.0)
    point = torch.tensor([0.3, -0.1, 0.2, 1.0], dtype=torch.float64)
    back = torch.tensor(frame.to_run(), dtype=torch.float64) @ point
    assert torch.allclose(
        moved.cameras[0].viewmat.double() @ point * torch.tensor([0.4, 0.4, 0.4, 1.0]),
        view.cameras[0].viewmat.double() @ back,
        atol=1e-5,
    )


@pytest.mark.parametrize("count", [60, 4000])
def test_the_box_holds_the_discs_and_a_thin_part_but_not_a_stray(count):
    generator = torch.Generator().manual_seed(count)
    corners = torch.cartesian_prod(*3 * [torch.tensor([0.0, 1.0])])
    cube = torch.cat([corners, torch.rand(count - 8, 3, generator=generator)])
    surfels = Surfels.of(
        torch.cat([cube, torch.tensor([[1.4, 0.5, 0.5], [50.0, 0.0, 0.0]])]),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count + 2, 1),
        torch.tensor([[math.log(0.2), math.log(0.1)]]).repeat(count + 2, 1),
        torch.zeros(count + 2),
        torch.zeros(count + 2, 1, 3),
    )
    # discs in the xy plane: they reach 0.2 along x, 0.1 along y, nothing along z
    for broken in (False, True):
        low, high = bounding_box(surfels)
        assert low.tolist() == pytest.approx([-0.2, -0.1, 0.0], abs=1e-6)
        assert high.tolist() == pytest.approx([1.6, 1.1, 1.0], abs=1e-6)
        if not broken:
            surfels.means[count // 2, 1] = math.nan
    low, high = bounding_box(surfels[:1])
    assert low.tolist() == pytest.approx([-0.2, -0.1, 0.0]) and high.tolist() == pytest.approx([0.2, 0.1, 0.0])
    assert bounding_box(surfels[:0])[0].tolist() == [0.0, 0.0, 0.0]


def test_the_2dgs_ply_has_what_the_official_code_reads(tmp_path):
    """The official reader takes columns by prefix in the order of their numbers, and wants 45 of f_rest_."""
    surfels = random_surfels(degree=1)
    item = ExportItem("cup", surfels, torch.ones(7, dtype=torch.int32))
    make_exporter("ply-2dgs").write(tmp_path / "cup.ply", item)
    element = read_vertices(tmp_path / "cup.ply")
    names_of_columns = element.dtype.names or ()

    def columns(prefix: str) -> np.ndarray:
        names = sorted(
            (name for name in names_of_columns if name.startswith(prefix)), key=lambda name: int(name.split("_")[-1])
        )
        return np.stack([element[name] for name in names], axis=1)

    assert np.array_equal(np.stack([element[axis] for axis in "xyz"], axis=1), surfels.means.numpy())
    rest = columns("f_rest_").reshape(7, 3, 15)
    assert np.array_equal(rest[:, :, :3], surfels.sh_rest.transpose(1, 2).numpy()) and not rest[:, :, 3:].any()
    assert np.array_equal(columns("scale_"), surfels.log_scales.numpy())
    assert np.allclose(columns("rot"), torch.nn.functional.normalize(surfels.quats, dim=1).numpy(), atol=1e-7)
    assert np.array_equal(element["opacity"], surfels.opacity_logits.numpy())


@pytest.mark.parametrize("kind", ["ply", "ply-2dgs"])
@pytest.mark.parametrize("frame", ["world", "object"])
def test_a_splat_file_looks_like_the_object(trained, tmp_path, kind, frame):
    """Read back, drawn from where the run's camera is in that frame, compared with the object drawn in the run."""
    main(["export", "--load-config", str(trained), "--object", "cup", "--format", kind, "--frame", frame,
          "--output", str(tmp_path)])  # fmt: skip
    (file,) = tmp_path.iterdir()
    surfels, ids = discs()
    cup, _ = select_class(surfels, Membership(ids), 1)
    read, read_ids = read_ply(file)
    assert read_ids is not None and read_ids.tolist() == [1] * len(cup)
    place = world_frame(trained)
    if frame == "object":
        low, high = bounding_box(place.surfels(cup))
        place = place.centred((low + high) / 2)
        low, high = bounding_box(read)
        assert (low + high).abs().max() < 1e-5
    for eye in ((2.0, 1.0, 1.5), (-1.0, 2.0, -0.5)):
        camera = camera_at(eye, cup.means.mean(dim=0))
        before = drawn(cup, camera)
        assert before.min() < 0.5
        views = place.views(Viewpoints([camera], make_rasterizer("auto"), SETTINGS))
        assert psnr(before, drawn(read, views.cameras[0], views.settings)) > 55


def test_all_writes_every_object_the_background_and_a_manifest(trained, tmp_path):
    main(["export", "--load-config", str(trained), "--all", "--frame", "object", "--format", "ply", "ply-2dgs",
          "--output", str(tmp_path / "out")])  # fmt: skip
    folder = tmp_path / "out"
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["run"] == str(trained) and (manifest["frame"], manifest["world"]) == ("object", "input")
    named = [(one["name"], one["class_id"]) for one in manifest["objects"]]
    assert named == [("cup", 1), ("box", 2), ("background", 0)]
    files = {file["path"] for one in manifest["objects"] for file in one["files"]}
    assert files == {path.name for path in folder.iterdir()} - {"manifest.json"} and len(files) == 6
    surfels, ids = discs()
    for one in manifest["objects"]:
        assert not one["left_out"]
        for file in one["files"]:
            assert (folder / file["path"]).stat().st_size == file["bytes"]
            vertex = read_vertices(folder / file["path"])
            assert len(vertex) == one["gaussians"] and set(vertex["class_id"]) == {one["class_id"]}
            there = np.stack([vertex["x"], vertex["y"], vertex["z"], np.ones(len(vertex))], axis=1)
            # the manifest's matrix leads back to the run
            expected = surfels.means[ids == one["class_id"]].numpy()
            assert np.allclose((there @ np.array(one["to_run"]).T)[:, :3], expected, atol=1e-5)


def test_quick_formats_come_before_slow_ones_and_all_of_an_object_before_the_next(trained, tmp_path, monkeypatch):
    from beags_plugin.export.mesh import GlbExporter
    from beags_plugin.export.spz import SpzExporter
    from beags_plugin.objects.export_job import ExportJob

    order: list[str] = []

    def write(job, label, exporter, path, item, class_id):
        order.append(path.name)
        return ExportedFile(label, None, {}, "only listed")

    assert GlbExporter.needs_views and not SpzExporter.needs_views
    monkeypatch.setattr(ExportJob, "_write", write)
    main(["export", "--load-config", str(trained), "--all", "--format", "glb", "spz", "--output", str(tmp_path)])
    assert order == [f"{name}.{kind}" for name in ("cup", "box", "background") for kind in ("spz", "glb")]


def test_meshes_of_a_run_lie_where_its_discs_are(trained, tmp_path, monkeypatch):
    """Meshes lie in the input's frame, made from the run's own views; the manifest tells what was left out, and why."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("open3d")
    arguments = ["export", "--load-config", str(trained), "--format", "glb", "--resolution", "64", "--output"]
    main([*arguments, str(tmp_path), "--all"])
    surfels, ids = discs()
    place = world_frame(trained)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    *objects, background = manifest["objects"]
    assert background["name"] == "background" and not background["files"]
    assert "name it with --object" in background["left_out"][0]["reason"]
    main([*arguments, str(tmp_path), "--object", "background"])
    assert (tmp_path / "background.glb").exists()
    for one in objects:
        (file,) = one["files"]
        vertices = trimesh.load_mesh(tmp_path / file["path"], process=False).vertices
        assert len(vertices) == file["vertices"] > 100
        there = place.surfels(surfels[ids == one["class_id"]])
        z_up = vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
        distances = torch.cdist(torch.from_numpy(np.array(z_up)).float(), there.means)
        radius = 3.0 * float(there.log_scales.exp().max())
        assert float((distances.min(dim=1).values < radius).float().mean()) > 0.99

    from beags_plugin.surfaces import fusion

    empty = fusion.Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32), 0.1)
    monkeypatch.setattr("beags_plugin.surfaces.meshing.fuse", lambda *_: empty)
    main([*arguments, str(tmp_path / "none"), "--all"])
    manifest = json.loads((tmp_path / "none/manifest.json").read_text())
    assert [path.name for path in (tmp_path / "none").iterdir()] == ["manifest.json"]
    told = [one["left_out"][0]["reason"] for one in manifest["objects"]]
    assert all("is seen in 3 training views" in reason for reason in told[:-1]) and len(told) == 3
    with pytest.raises(SystemExit):  # named alone it is a mistake
        main([*arguments, str(tmp_path / "none"), "--object", "cup"])


def test_closed_objects_say_what_is_invented(trained, tmp_path, capsys):
    """A column of the .ply, an attribute of the .glb; the background and the whole scene stay as they are."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("open3d")
    steps: list[tuple[int, int]] = []
    arguments = ["export", "--load-config", str(trained), "--resolution", "48", "--min-views", "1", "--format", "ply"]
    main([*arguments, "ply-2dgs", "spz", "glb", "--all", "--whole", "--close", "--output", str(tmp_path)])
    said = " ".join(capsys.readouterr().out.split())
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    for one in manifest["objects"]:
        plain = [read_vertices(tmp_path / file["path"]) for file in one["files"] if file["format"].startswith("ply")]
        if one["name"] == "background" or one["class_id"] is None:
            assert "closing_gaussians" not in one and all(len(table) == one["gaussians"] for table in plain)
            assert all("invented" not in (table.dtype.names or ()) for table in plain)
        if one["name"] == "background":
            continue
        mesh = next(file for file in one["files"] if file["format"] == "glb")
        (read,) = trimesh.load(tmp_path / mesh["path"], process=False).geometry.values()
        if one["class_id"] is None:
            assert "_INVENTED" not in read.vertex_attributes
            continue
        closing = one["closing_gaussians"]
        # This object has few and large Gaussians, so it may get none; test_closing.py has objects that get some.
        added = closing["gaussians"]
        doubted = f"nothing closed, as {closing['doubt']}" if closing["doubt"] else "nothing to close"
        assert f"; {f'{added} more close what no photo shows' if added else doubted}" in said
        for table in plain:
            assert len(table) == one["gaussians"] + added and table["invented"].sum() == added
            assert not table["invented"][: one["gaussians"]].any() and set(table["class_id"]) == {one["class_id"]}
        assert np.ravel(read.vertex_attributes["_INVENTED"]).any() and 0 <= mesh["closed_share"] < 1
    surfels, ids = read_ply(tmp_path / "cup.ply")  # other readers pass over the column
    assert ids is not None and len(surfels) == len(ids)
    export_run(
        trained, ["cup", "box"], formats=("ply", "spz"), output=tmp_path / "again", closing=MeshOptions(resolution=16),
        progress=lambda *counts: steps.append(counts),
    )  # fmt: skip
    assert [done for done, _ in steps] == [0, *range(1, 9), 9, 10, *range(11, 20), 20][: len(steps)]
    assert steps[-1] == (20, 20)


def test_closing_needs_the_data_and_leaves_nothing_without(tmp_path, capsys):
    pytest.importorskip("open3d")
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    (tmp_path / "lab").rename(tmp_path / "away")
    with pytest.raises(SystemExit) as stopped:
        main(["export", "--load-config", str(config), "--all", "--close"])
    assert stopped.value.code == 2 and "lab: name their place with --data" in capsys.readouterr().out
    assert not (config.parent / "exports").exists()


def test_the_progress_of_meshes_counts_their_views(trained, tmp_path):
    """Seven training views: a mesh takes 8 steps, the same mesh in another file 8 at once, a splat file 1."""
    pytest.importorskip("open3d")
    steps: list[tuple[int, int]] = []
    export_run(
        trained, ["cup", "box"], formats=("ply", "glb", "obj"), output=tmp_path,
        options={name: {"resolution": 16} for name in ("glb", "obj")}, progress=lambda *counts: steps.append(counts),
    )  # fmt: skip
    assert {total for _, total in steps} == {2 * (1 + 8 + 8)}
    assert [done for done, _ in steps] == [0, *range(1, 10), 17, 18, *range(19, 27), 34]


def test_the_background_keeps_its_splats_in_a_format_of_both(trained, tmp_path, capsys):
    pytest.importorskip("open3d")
    main(["export", "--load-config", str(trained), "--all", "--format", "gltf-both", "glb", "--resolution", "8",
          "--output", str(tmp_path)])  # fmt: skip
    said = " ".join(capsys.readouterr().out.split())
    assert "background.both.glb (no mesh, as one of the background takes long)" in said
    assert "no glb: a mesh of the background takes long" in said and not (tmp_path / "background.glb").exists()
    assert len(read_scene(tmp_path / "background.both.glb").gaussians) == 25
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    (background,) = (each for each in manifest["objects"] if each["name"] == "background")
    assert [each.get("mesh", "")[:4] for each in background["files"]] == ["none"]


def test_meshes_need_the_data(tmp_path, capsys):
    pytest.importorskip("open3d")
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    (tmp_path / "lab").rename(tmp_path / "away")
    with pytest.raises(SystemExit):
        main(["export", "--load-config", str(config), "--all", "--format", "obj"])
    assert "lab: name their place with --data" in capsys.readouterr().out
    main(["export", "--load-config", str(config), "--all", "--format", "spz"])  # splats do not
    assert len(list((config.parent / "exports").glob("*.spz"))) == 3


def test_an_exporter_of_another_package(trained, tmp_path, monkeypatch):
    """The exporter is the one that docs/extending.md shows."""
    monkeypatch.setitem(EXPORTERS._specs, "xyz", "test_export:PointsExporter")
    main(["export", "--load-config", str(trained), "--object", "cup", "--format", "xyz", "--output", str(tmp_path)])
    assert np.loadtxt(tmp_path / "cup.xyz").shape == (25, 3)


@dataclass(frozen=True)
class PointsExporter(Exporter):
    suffix: ClassVar[str] = "xyz"
    digits: int = 6

    def write(self, path: Path, item: ExportItem) -> dict[str, Any]:
        with whole_file(path) as part, open(part, "w") as file:
            np.savetxt(file, item.surfels.means.numpy(), f"%.{self.digits}g")
        return {"points": len(item.surfels)}


def test_extract_and_export_write_the_same_ply(trained, tmp_path):
    main(["extract", "--load-config", str(trained), "--object", "cup", "--output", str(tmp_path / "runs")])
    main(["export", "--load-config", str(trained), "--object", "cup", "--output", str(tmp_path)])
    assert (tmp_path / "cup.ply").read_bytes() == (tmp_path / "runs/cup/cup.ply").read_bytes()


def test_the_whole_scene_is_a_gltf_with_a_node_for_each_class(trained, tmp_path):
    main(["export", "--load-config", str(trained), "--whole", "--format", "gltf-splats", "--output", str(tmp_path)])
    data = (tmp_path / "whole_scene.splats.glb").read_bytes()
    content = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert {node["extras"]["class_id"]: node["name"] for node in content["nodes"]} == CLASSES


def test_an_object_called_as_the_whole_scene_has_a_file_of_its_own(trained, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "WHOLE", "Cup")
    main(["export", "--load-config", str(trained), "--object", "cup", "--whole", "--output", str(tmp_path)])
    counts = {path.name: len(read_vertices(path)) for path in tmp_path.glob("*.ply")}
    assert counts.keys() == {"Cup.ply", "cup_1.ply"} and counts["Cup.ply"] > counts["cup_1.ply"] > 0


def test_mistakes_leave_no_files(trained, tmp_path, capsys):
    base = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), assigned=False)
    for config, options, message in (
        (trained, ["--all", "--object", "cup"], "--all exports every object: leave --object out."),
        (base, ["--all"], "is a base without classes: refine it first"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main(["export", "--load-config", str(config), *options])
        assert stopped.value.code == 2 and message in capsys.readouterr().out
        assert not (config.parent / "exports").exists()
