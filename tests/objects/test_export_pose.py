"""Exports turned, shifted and scaled: files read back, against where the run's Gaussians are."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from random_surfels import SETTINGS, a_rotation, camera_at, drawn, psnr
from run_folders import discs, write_drawn_scene, write_prepared, write_scene, write_trained

pytest.importorskip("nerfstudio")

from written_splats import read_ply

from beags_plugin.commands.cli import main
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.export.pose_options import PhotoPoint
from beags_plugin.objects.pose import _pixel
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.runs.read import read_run
from beags_plugin.splat_io.frames import read_transform
from beags_plugin.surfaces.frames import Frame
from beags_plugin.surfaces.item import Viewpoints
from beags_plugin.system.errors import UserError


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """Return config.yml of a run whose data parser has turned and scaled the world."""
    root = tmp_path_factory.mktemp("lab")
    config = write_trained(root / "run", write_scene(root / "lab"))
    transform = torch.cat([a_rotation(3), torch.tensor([[0.4], [-0.2], [0.1]], dtype=torch.float64)], dim=1)
    (root / "run/dataparser_transforms.json").write_text(json.dumps({"transform": transform.tolist(), "scale": 0.5}))
    return config


def export(config: Path, *options: str) -> None:
    main(["export", "--load-config", str(config), *options])


def test_splats_turned_scaled_and_shifted_look_the_same(trained, tmp_path):
    """The file's .ply, drawn from where the run's camera is by the manifest's matrix, against the run's own picture."""
    export(trained, "--all", "--up", "1,2,-3", "--centre", "--scale-by", "0,0,0 0,0,2 50 cm", "--output", str(tmp_path))
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["unit"] == "metre" and manifest["metres_per_world_unit"] == pytest.approx(0.25)
    one = next(each for each in manifest["objects"] if each["name"] == "cup")
    direction = np.array([1, 2, -3]) / 14**0.5
    assert np.allclose(one["up"], direction, atol=1e-6)
    assert np.allclose(np.add(one["box"]["low"], one["box"]["high"])[:2], 0, atol=1e-5)
    assert one["box"]["low"][2] == pytest.approx(0, abs=1e-6)
    to_run = torch.tensor(one["to_run"], dtype=torch.float64)
    scale = float(torch.linalg.det(to_run[:3, :3])) ** (1 / 3)
    assert scale == pytest.approx(0.5 / 0.25)  # run units in a metre
    cup, _ = select_class(discs()[0], Membership(discs()[1]), 1)
    read, _ = read_ply(tmp_path / "cup.ply")
    assert np.allclose(read.means.double() @ to_run[:3, :3].T + to_run[:3, 3], cup.means, atol=1e-5)
    frame = Frame(to_run[:3] / scale, scale)
    views = frame.views(
        Viewpoints([camera_at((2.0, 1.0, 1.5), cup.means.mean(dim=0))], make_rasterizer("auto"), SETTINGS)
    )
    before = drawn(cup, camera_at((2.0, 1.0, 1.5), cup.means.mean(dim=0)))
    assert before.min() < 0.5 and psnr(before, drawn(read, views.cameras[0], views.settings)) > 50


def test_pixels_of_photos_give_the_scale(tmp_path):
    """The distance of two places that are rendered, by hand, from the run's own depth."""
    root = tmp_path / "lab"
    write_drawn_scene(root)
    config = write_trained(tmp_path / "run", root)
    from beags_plugin.core.lifting import lift
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.rasterizers.rendering import geometry_inputs
    from beags_plugin.runs.run import Run

    scene = read_run(config)
    run = EvaluatedRun(config)
    views = Run(config).viewpoints
    names = [path.stem for path in run.views.manager.train_dataset.image_filenames]
    places = []
    for view in (0, 2):
        drawn_view = views.rasterizer.rasterize(
            geometry_inputs(scene.surfels()), views.cameras[view], views.settings, torch.zeros(3)
        )
        solid = drawn_view.median_depth > 0
        row, column = (int(each) for each in solid.nonzero()[int(solid.sum()) // 2])
        places.append((names[view], column, row, lift(drawn_view.median_depth, views.cameras[view])[row, column]))
    transform = read_transform(config.parent)
    unit = 1.0 if transform is None else transform[1]
    apart = float((places[0][3] - places[1][3]).norm()) / unit
    first, second = (f"{name}:{column},{row}" for name, column, row, _ in places)
    export(config, "--all", "--scale-by", f"{first} {second} 3 m", "--output", str(tmp_path / "out"))
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    assert manifest["metres_per_world_unit"] == pytest.approx(3 / apart, rel=1e-4)


def test_a_file_name_of_two_photos_is_refused():
    files = [[Path("cam0/1.png"), Path("cam1/1.png")], [Path("cam2/2.png")]]
    train, held_out = (SimpleNamespace(image_filenames=each) for each in files)
    manager: Any = SimpleNamespace(train_dataset=train, eval_dataset=held_out)
    with pytest.raises(UserError, match="2 photos are called '1.png': name one of cam0_1, cam1_1"):
        _pixel(PhotoPoint("1.png", 0.0, 0.0), manager)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--format", "3mf"], "a .3mf file is in millimetres, but the size of the scene is not known"),
        (["--scale-by", "0,0,0 0,0,0 1 m"], "the two points of scale_by are the same"),
        (["--scale-by", "nowhere:1,1 v01:2,2 1 m"], "no photo is called 'nowhere': name one such as v0"),
        (["--scale-by", "v01:2,5000 v01:1,1 1 m"], "v01 has 20 x 12 pixels: 2,5000 is not one"),
        (["--centre", "--frame", "object"], "leave one out"),
        (
            ["--up", "plane"],
            "what 'cup' stands on is not known, as the run has no saved masks: name the direction",
        ),
    ],
)
def test_mistakes_leave_no_files(trained, tmp_path, capsys, options, sentence):
    with pytest.raises(SystemExit) as stopped:
        export(trained, "--object", "cup", "--output", str(tmp_path / "out"), *options)
    assert stopped.value.code == 2
    assert sentence in " ".join(capsys.readouterr().out.split())
    assert not (tmp_path / "out").exists()


def test_what_stands_on_nothing_is_left_out_of_all(tmp_path):
    """With --all the manifest says why, and the background is written."""
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    write_prepared(tmp_path / "run")
    export(config, "--all", "--up", "plane", "--output", str(tmp_path / "out"))
    manifest = json.loads((tmp_path / "out/manifest.json").read_text())
    reasons = {one["name"]: [each["reason"] for each in one["left_out"]] for one in manifest["objects"]}
    assert not reasons["background"] and all("views show no plane that" in reasons[name][0] for name in ("cup", "box"))


def test_prints_are_closed_and_as_large_as_was_said(trained, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("open3d")
    export(trained, "--object", "cup", "--format", "stl", "3mf", "ply", "--scale-by", "0,0,0 1,0,0 20 cm",
           "--resolution", "64", "--output", str(tmp_path))  # fmt: skip
    means = read_ply(tmp_path / "cup.ply")[0].means.numpy()
    for name in ("cup.stl", "cup.3mf"):
        solid = trimesh.load_mesh(tmp_path / name)
        solid = solid.to_mesh() if hasattr(solid, "to_mesh") else solid
        assert solid.is_watertight and solid.volume > 0
        middle = solid.bounds.mean(axis=0) / 1000  # metres
        assert np.linalg.norm(middle - means.mean(axis=0)) < 0.2 * np.ptp(means, axis=0).max()
        assert solid.extents.max() / 1000 == pytest.approx(np.ptp(means, axis=0).max(), rel=0.6)
    import zipfile

    with zipfile.ZipFile(tmp_path / "cup.3mf") as archive:
        model = archive.read("3D/3dmodel.model")
    assert b'unit="millimeter"' in model
    uuids = re.findall(rb'UUID="([^"]*)"', model)
    assert len(set(uuids)) == len(uuids) >= 2
    first = (tmp_path / "cup.3mf").read_bytes()
    export(trained, "--object", "cup", "--format", "3mf", "--scale-by", "0,0,0 1,0,0 20 cm",
           "--resolution", "64", "--output", str(tmp_path))  # fmt: skip
    assert (tmp_path / "cup.3mf").read_bytes() == first
