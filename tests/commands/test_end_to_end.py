"""All steps through a user's command lines: ns-train, ns-eval, beags extract, ns-export, ns-render.

Programs of nerfstudio are started; a second training and beags run in this process, which saves their start.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from called_programs import called

pytest.importorskip("nerfstudio")
yaml = pytest.importorskip("yaml")

from beags_plugin.sample.writer import SampleConfig, write_sample
from beags_plugin.system.child_processes import bound
from beags_plugin.system.reading.ply import read_vertices

BIN = Path(sys.executable).parent


def run(*command, **options):
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", "COLUMNS": "200"}
    done = subprocess.run(
        bound([BIN / command[0], *command[1:]]),
        capture_output=True, text=True, env=environment, timeout=900, **options,
    )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "sample"
    write_sample(folder, SampleConfig(seed=3, width=96, height=72, num_train=16, num_test=3))
    return folder


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """A very short run of beags-tiny, both phases."""
    folder = tmp_path_factory.mktemp("outputs") / "run"
    code, text = run(
        "ns-train", "beags-tiny", "--data", data, "--run-dir", folder, "--vis", "tensorboard",
        "--pipeline.model.base-steps", 220, "--pipeline.model.refine-steps", 40, "--steps-per-save", 100,
        "--pipeline.model.prepare.k", 200, "--steps-per-eval-image", 100,
    )  # fmt: skip
    assert code == 0, text[-4000:]
    return folder, text


def test_training_reports_its_stages(trained):
    folder, text = trained
    for words in ("reprojection:", "assignment: Gaussians per class", "voxel size", "never seen"):
        assert words in text
    assert (folder / "config.yml").exists()
    assert sorted(path.name for path in (folder / "nerfstudio_models").iterdir()) == ["step-000000259.ckpt"]
    report = json.loads((folder / "prepared" / "report.json").read_text())
    assert set(report["seconds"]) == {"reprojection", "assignment", "voxel grids"}


def test_the_base_is_kept_apart_and_has_classes(trained):
    from beags_plugin.runs.run import Run

    folder, _ = trained
    base, refined = Run(folder / "base" / "config.yml").assigned, Run(folder / "config.yml").assigned
    means, moved = base.state["gauss_params.means"], refined.state["gauss_params.means"]
    own = len(means)  # those that close contacts come after them
    assert len(moved) >= own and (base.state["class_ids"] == refined.state["class_ids"][:own]).all()
    assert not any((moved[:own] == position).all(dim=1).any() for position in means[base.state["class_ids"] > 0])
    assert len(base.classes) >= 6
    assert (base.state["class_ids"] > 0).any()


@pytest.fixture(scope="module")
def extracted(trained):
    folder, _ = trained
    called("beags", "extract", "--load-config", folder / "config.yml")
    return sorted(folder.glob("extracted/*/config.yml"))


def test_extraction_writes_a_run_and_a_ply_per_object(trained, extracted):
    from beags_plugin.runs.layout import EXTRACTION_FILE
    from beags_plugin.runs.run import Run

    folder, _ = trained
    whole = Run(folder / "config.yml").assigned
    assert len(extracted) >= 5
    for config in extracted:
        scene = Run(config).assigned
        (index,) = scene.state["class_ids"].unique().tolist()
        own = whole.state["class_ids"] == index
        quats = scene.state["gauss_params.quats"]
        assert {*map(tuple, quats.tolist())} <= {*map(tuple, whole.state["gauss_params.quats"][own].tolist())}
        left_out = json.loads((config.parent / EXTRACTION_FILE).read_text())["left_out"]
        (ply,) = config.parent.glob("*.ply")
        vertex = read_vertices(ply)
        assert len(vertex) == len(quats) == int(own.sum()) - left_out["outside"] - left_out["loose"]
        assert (np.asarray(vertex["class_id"]) == index).all()
        assert {"scale_0", "scale_1", "scale_2"} <= set(vertex.dtype.names)


@pytest.mark.slow("starts nerfstudio's evaluation")
def test_the_figures_are_those_of_ns_eval(trained, tmp_path):
    folder, _ = trained
    ours, theirs = tmp_path / "ours.json", tmp_path / "theirs.json"
    called("beags", "eval", "--load-config", folder / "config.yml", "--json", ours, "--picture", tmp_path / "a.png")
    code, text = run("ns-eval", "--load-config", folder / "config.yml", "--output-path", theirs)
    assert code == 0, text[-3000:]
    found, expected = json.loads(ours.read_text()), json.loads(theirs.read_text())["results"]
    assert expected["psnr"] > 10
    for metric in ("psnr", "ssim"):
        assert found[metric]["after"] == pytest.approx(expected[metric], rel=1e-4)
    assert len(found["objects"]) >= 5 and (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.slow("starts a process for each nerfstudio command")
def test_nerfstudio_commands_work_on_an_extracted_run(extracted, tmp_path):
    config = extracted[0]
    code, text = run("ns-export", "gaussian-splat", "--load-config", config, "--output-dir", tmp_path / "export")
    assert code == 0, text[-3000:]
    (ply,) = (tmp_path / "export").glob("*.ply")
    assert len(read_vertices(ply)) > 0
    code, text = run(
        "ns-render", "dataset", "--load-config", config, "--output-path", tmp_path / "render",
        "--rendered-output-names", "rgb", "--split", "test",
    )  # fmt: skip
    assert code == 0, text[-3000:]
    assert len(list((tmp_path / "render").rglob("*.jpg"))) == 3


def test_export_writes_every_object_and_the_background(trained, tmp_path):
    folder, _ = trained
    called(
        "beags", "export", "--load-config", folder / "config.yml", "--all", "--format", "ply", "ply-2dgs", "spz", "glb",
        "--resolution", 48, "--output", tmp_path,
    )  # fmt: skip
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert len(manifest["objects"]) >= 6 and manifest["frame"] == "world"
    for one in manifest["objects"]:
        written = {file["format"]: file for file in one["files"]}
        assert {"ply", "ply-2dgs", "spz"} <= set(written) and all((tmp_path / f["path"]).exists() for f in one["files"])
        assert len(read_vertices(tmp_path / written["ply"]["path"])) == one["gaussians"]
    assert sum(file["format"] == "glb" for one in manifest["objects"] for file in one["files"]) >= 3


def test_removing_an_object_keeps_the_rest(trained):
    from beags_plugin.objects.extract import extract_objects
    from beags_plugin.runs.run import Run

    folder, _ = trained
    whole = Run(folder / "config.yml").assigned
    name = whole.classes[1]
    (rest,) = extract_objects(folder / "config.yml", [name], remove=True)
    assert rest.gaussians == int((whole.state["class_ids"] != 1).sum())


def test_a_run_that_was_refining_is_resumed_with_its_classes_and_masks(trained, data, tmp_path):
    from beags_plugin.runs.run import Run

    folder, _ = trained
    text = called(
        "ns-train", "beags-tiny", "--data", data, "--run-dir", tmp_path / "resumed", "--vis", "tensorboard",
        "--load-dir", folder / "nerfstudio_models",
        "--pipeline.model.base-steps", 220, "--pipeline.model.refine-steps", 44, "--pipeline.model.prepare.k", 200,
    )  # fmt: skip
    assert "refinement continues from" in text and "Gaussians per class" not in text
    before, after = Run(folder / "config.yml").assigned, Run(tmp_path / "resumed" / "config.yml").assigned
    assert after.step == 263 and int(after.state["refined_steps"]) == 44
    assert (before.state["class_ids"] == after.state["class_ids"]).all()
    assert (tmp_path / "resumed" / "base" / "config.yml").exists()


def test_a_crop_box_leaves_nothing_outside_of_it(trained):
    from nerfstudio.data.scene_box import OrientedBox
    from nerfstudio.utils.eval_utils import eval_setup

    _, pipeline, _, _ = eval_setup(trained[0] / "config.yml", test_mode="test")
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    box = OrientedBox.from_params((9.0, 9.0, 9.0), (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    assert float(pipeline.model.get_outputs_for_camera(camera)["accumulation"].sum()) > 0.0
    assert float(pipeline.model.get_outputs_for_camera(camera, obb_box=box)["accumulation"].sum()) == 0.0


def test_demo_on_a_folder_writes_table_figures_and_picture(trained, data, tmp_path):
    """The measuring half of the demo, on the run that is there."""
    from beags_plugin.commands.demo import measure
    from beags_plugin.commands.demo_again import Again
    from beags_plugin.commands.scene_setup import MadeScene

    folder, _ = trained
    measure(folder, tmp_path, {}, MadeScene(data), Again(data))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary) == {"mean", "objects", "psnr", "seconds", "peak_memory_mb", "certainty"}
    for kind in ("extracted", "rendered"):
        for stage in ("assigned", "refined"):
            assert all(0.0 <= summary["mean"][kind][stage][name] <= 1.0 for name in ("acc", "iou", "biou"))
    assert len(summary["objects"]) >= 5 and summary["psnr"]["after"] > 10
    assert (tmp_path / "contact_sheet.png").stat().st_size > 10_000
