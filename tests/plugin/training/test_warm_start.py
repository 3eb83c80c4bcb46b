"""Runs that start from a trained scene: frames, flattening, and the report of how well it fits."""

from __future__ import annotations

import json
import shutil

import pytest
import torch
from run_folders import discs
from start_scenes import a_frame, drawn, in_frame, with_volume, write_splatfacto, write_start_scene

pytest.importorskip("nerfstudio")

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.plugin.presets import preset_config
from beags_plugin.splat_io.ply import write_ply
from beags_plugin.system.errors import UserError


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_start_scene(tmp_path_factory.mktemp("data"))


def config_of(scene, run, preset="beags-refine", **options):
    overrides = {f"pipeline.model.{name}": value for name, value in options.items()}
    config = preset_config(preset, {"vis": "tensorboard", **overrides}, run)
    config.data_config.data = scene.root
    config.run_dir = run
    return config


def started(scene, run, start, **options):
    """A trainer that has been set up from ``start``, and its report of the start."""
    config = config_of(scene, run, start_from=start, **options)
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer, json.loads((run / "start.json").read_text())


def as_3dgs(path, surfels: Surfels) -> None:
    """A 3DGS .ply by hand: columns in the official order, axes in any order."""
    log_scales, quats = with_volume(surfels)
    rest = surfels.sh_rest.transpose(1, 2).flatten(1)
    columns = [surfels.means, torch.zeros(len(surfels), 3), surfels.sh_dc, rest, surfels.opacity_logits[:, None]]
    table = torch.cat([*columns, log_scales, quats], dim=1)
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [*(f"f_rest_{i}" for i in range(rest.shape[1])), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(surfels)}"]
    header += [*(f"property float {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.numpy().astype("<f4").tobytes())


def same_pictures(trainer, surfels: Surfels) -> float:
    """Largest difference of a colour between the scene of the trainer and surfels in its frame, in all views."""
    model, views = trainer.pipeline.model, trainer.pipeline.datamanager.views("train")
    settings = model.settings(geometry=False)
    pairs = [(drawn(model.surfels().detach(), v.camera, settings), drawn(surfels, v.camera, settings)) for v in views]
    return max(float((a - b).abs().max()) for a, b in pairs)


@pytest.mark.parametrize("kind", ["2dgs", "3dgs", "ours", "splatfacto", "run"])
def test_a_scene_is_rendered_as_it_was_whatever_file_it_comes_from(scene, tmp_path, kind):
    """The photos are renders of the discs: what reaches their rounding to bytes has frame, shape and colour right."""
    start = tmp_path / "scene.ply"
    if kind == "2dgs":
        write_ply(start, scene.surfels, layout="2dgs")
    elif kind == "3dgs":
        as_3dgs(start, scene.surfels)
    elif kind == "ours":
        write_ply(start, scene.surfels, torch.zeros(len(scene.surfels), dtype=torch.int32))
    else:
        frame = a_frame(9, 0.3)
        start = write_splatfacto(tmp_path / "theirs", in_frame(scene.surfels, frame), frame)
        start = start / "config.yml" if kind == "run" else next(start.rglob("*.ckpt"))
        (tmp_path / "theirs" / "config.yml").write_text("of another program")
    trainer, report = started(scene, tmp_path / "run", start)
    outputs = trainer.pipeline.datamanager.train_dataparser_outputs
    expected = in_frame(scene.surfels, (outputs.dataparser_transform, float(outputs.dataparser_scale)))
    assert same_pictures(trainer, expected) < 1e-3
    assert report["psnr"] > 45 and report["gaussians"] == 75 and report["dropped"] == 0
    assert report["flat_psnr"] < 25 and report["views"] == 7
    if kind == "2dgs":
        assert report["flattening"] is None
    else:
        assert report["flattening"]["median_ratio"] == pytest.approx(1e-3, rel=1e-3)
    held = [group["params"][0] for o in trainer.optimizers.optimizers.values() for group in o.param_groups]
    assert {id(parameter) for parameter in held} == {id(p) for p in trainer.pipeline.model.gauss_params.values()}


def test_a_run_of_the_same_frame_is_taken_bit_for_bit(scene, tmp_path):
    first, _ = started(scene, tmp_path / "first", write_splatfacto(tmp_path / "a", discs()[0], a_frame(2)))
    first.save_checkpoint(0)
    outputs = first.pipeline.datamanager.train_dataparser_outputs
    outputs.save_dataparser_transform(tmp_path / "first" / "dataparser_transforms.json")
    second, report = started(scene, tmp_path / "second", tmp_path / "first")
    for name, value in first.pipeline.model.gauss_params.items():
        assert torch.equal(value, second.pipeline.model.gauss_params[name]), name
    assert report["kind"] == "run of beags" and report["flattening"] is None


@pytest.mark.parametrize("form", ["ply", "ply-2dgs"])
def test_a_base_is_exported_whole_and_started_from_again(scene, tmp_path, form):
    """The scene goes to the world of the input poses and back: the training views are as they were."""
    from beags_plugin.commands.cli import main

    start = write_splatfacto(tmp_path / "a", in_frame(scene.surfels, a_frame(4)), a_frame(4))
    base, report = started(scene, tmp_path / "base", start)
    base.config.save_config()
    base.save_checkpoint(0)
    outputs = base.pipeline.datamanager.train_dataparser_outputs
    outputs.save_dataparser_transform(tmp_path / "base" / "dataparser_transforms.json")
    config, files = tmp_path / "base" / "config.yml", tmp_path / "files"
    main(["export", "--load-config", str(config), "--whole", "--format", form, "--output", str(files)])
    (ply,) = files.glob("whole_scene*.ply")
    again, returned = started(scene, tmp_path / "again", ply)
    assert returned["psnr"] == pytest.approx(report["psnr"], abs=0.01) and returned["frame"] == "world"
    assert same_pictures(again, base.pipeline.model.surfels().detach()) < 1e-3
    assert again.pipeline.model.config.sh_degree == 1


def test_a_wrong_frame_is_reported_with_the_figure_and_the_frame_that_fits(scene, tmp_path, capsys):
    right = write_splatfacto(tmp_path / "a", scene.surfels, (torch.eye(4)[:3], 1.0))
    trainer, _ = started(scene, tmp_path / "right", right)
    capsys.readouterr()
    normalised = tmp_path / "normalised.ply"  # ns-export writes such files.
    write_ply(normalised, trainer.pipeline.model.surfels().detach())
    _, report = started(scene, tmp_path / "wrong", normalised)
    output = " ".join(capsys.readouterr().out.split())
    assert f"with {report['psnr']:.1f} dB, hardly better than one flat colour" in output
    assert "it fits better with --pipeline.model.start-frame normalised" in output
    _, report = started(scene, tmp_path / "better", normalised, start_frame="normalised")
    assert report["psnr"] > 45 and "hardly better" not in capsys.readouterr().out


def test_refinement_starts_from_a_ply_and_does_not_need_it_later(scene, tmp_path):
    from nerfstudio.utils.eval_utils import eval_setup

    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.objects.extract import extract_objects
    from beags_plugin.plugin.launch import train

    ply, run = tmp_path / "scene.ply", tmp_path / "run"
    write_ply(ply, scene.surfels, layout="2dgs")
    config = config_of(scene, run, refine_steps=2, start_from=ply)
    config.model_config.prepare = type(config.model_config.prepare)(k=5)
    train(config)
    ply.unlink()
    after = EvaluatedRun(run / "config.yml")
    assert set(after.stages) == {"before", "after"} and len(after.stages["after"].surfels()) == 75
    assert extract_objects(run / "config.yml", output=tmp_path / "objects")
    _, pipeline, _, step = eval_setup(run / "config.yml", test_mode="test")
    assert step == 1 and pipeline.model.num_points == 75
    # a resumed run goes on from its checkpoint, not from the file, which is gone
    again = config_of(scene, tmp_path / "again", refine_steps=4, start_from=ply)
    again.load_dir = run / "nerfstudio_models"
    train(again)
    assert not (tmp_path / "again" / "start.json").exists()


def test_base_steps_polish_a_scene_without_growth(scene, tmp_path):
    from beags_plugin.plugin.launch import train

    run = tmp_path / "run"
    start = write_splatfacto(tmp_path / "theirs", scene.surfels, (torch.eye(4)[:3], 1.0))
    options = {"base_steps": 6, "refine_steps": 0, "schedule_steps": 0, "densify.start": 0, "densify.every": 1}
    config = config_of(scene, run, "beags-base", start_from=start, **options)
    train(config)
    (checkpoint,) = run.rglob("*.ckpt")
    state = torch.load(checkpoint, weights_only=True)["pipeline"]
    means = state["_model.gauss_params.means"]
    assert len(means) == 75
    shutil.rmtree(run)
    trainer, _ = started(scene, run, start)
    moved = (means - trainer.pipeline.model.means).norm(dim=1)
    assert 0 < float(moved.max()) < 1e-3 * float(trainer.pipeline.model.extent)
    assert trainer.pipeline.model.train().active_sh_degree() == 1  # all of it, from the first step


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("absent.ply", "absent.ply does not exist: name a splat file, a checkpoint or a run to start from"),
        ("notes.txt", "notes.txt is nothing to start from: name one of these: a run of splatfacto or beags"),
    ],
)
def test_what_is_no_scene_is_refused_before_the_data_are_read(scene, tmp_path, name, words):
    (tmp_path / "notes.txt").write_text("hello")
    trainer = config_of(scene, tmp_path / "run", start_from=tmp_path / name).setup(local_rank=0, world_size=1)
    with pytest.raises(SystemExit) as end:
        trainer.setup()
    assert isinstance(end.value.__cause__, UserError) and words in str(end.value.__cause__)


def test_quaternions_of_the_synthetic_files_differ_from_the_discs(scene):
    """The files that these tests read are no mere copies: most have their thin axis first or second."""
    log_scales, quats = with_volume(scene.surfels)
    thin = log_scales.argmin(dim=1)
    assert {0, 1, 2} == set(thin.tolist())
    normal = rotation_from_quat(quats)[torch.arange(len(quats)), :, thin]
    dots = (normal * rotation_from_quat(scene.surfels.quats)[:, :, 2]).sum(dim=1).abs()
    assert torch.allclose(dots, torch.ones_like(dots), atol=1e-5)
