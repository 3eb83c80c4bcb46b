"""Runs that were copied or moved work from where they lie, in the commands of beags and in those of nerfstudio."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio")

from called_programs import called
from resumed_runs import checkpoint_of
from run_folders import write_prepared, write_scene, write_trained

from beags_plugin.objects.extract import extract_objects
from beags_plugin.plugin.options.relocated import named
from beags_plugin.runs.layout import preparing_run
from beags_plugin.runs.relocation import open_run
from beags_plugin.system.errors import UserError


@pytest.fixture
def moved(tmp_path) -> Path:
    """A run with an extract, moved with its data; in its old place a run that cannot be read."""
    old = tmp_path / "old"
    config = write_trained(old / "outputs/run", write_scene(old / "lab"))
    write_prepared(config.parent)
    extract_objects(config, ("cup",), keep_all=True)  # the masks are not those of the discs
    shutil.copytree(old, tmp_path / "new")
    for checkpoint in old.rglob("*.ckpt"):
        checkpoint.write_bytes(b"read from the old place")
    shutil.rmtree(old / "lab")
    return tmp_path / "new/outputs/run"


def files(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*")}


COMMANDS = {  # Command to the file that it writes beside config.yml.
    "extract --object box": "extracted/box/box.ply",
    "extract --object cup --remove": "extracted/without_cup/without_cup.ply",
    "export --whole": "exports/whole_scene.ply",
    "export --object cup --format obj --resolution 8": "exports/cup.obj",
    "render --object cup --format before-after --size 32 --views 2": "renders/cup_before-after.png",
    "masks reproject": "reprojected/report.json",
    "eval": "",
    "masks check --output {tmp}/checked": "",
}


@pytest.mark.parametrize("words", COMMANDS)
def test_beags_reads_and_writes_where_the_run_lies(moved, tmp_path, words):
    before = files(tmp_path / "old")
    name, *rest = words.format(tmp=tmp_path).split()
    sub = [rest.pop(0)] if name == "masks" else []
    said = called("beags", name, *sub, "--load-config", moved, *rest)
    assert said.count(f"This run was trained in {tmp_path}/old/outputs/run; it is read, and written to, where") == 1
    assert said.count(str(moved)) >= 1 and (moved / COMMANDS[words]).exists()
    assert files(tmp_path / "old") == before


def test_an_extract_and_the_base_move_along(moved, tmp_path):
    assert preparing_run(moved / "extracted/cup") == moved
    for part, count in (("extracted/cup", 25), ("base", 75)):
        config = open_run(moved / part / "config.yml")
        assert config.data_path == tmp_path / "new/lab"
        state = torch.load(next(config.get_checkpoint_dir().iterdir()), weights_only=True)["pipeline"]
        assert len(state["_model.class_ids"]) == count


def test_data_are_found_beside_the_run_too(tmp_path):
    data = write_scene(tmp_path / "far/away/lab")
    run = tmp_path / "there/run"
    shutil.copytree(write_trained(tmp_path / "run", data).parent, run)
    assert open_run(run / "config.yml").data_path == data  # The old place counts as long as the data are there.
    for place in (run.parent / "lab", run / "lab"):
        data = data.rename(place)
        assert open_run(run / "config.yml").data_path == place


def test_data_elsewhere_are_named_by_an_option(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    (tmp_path / "lab").rename(tmp_path / "disk")
    for words in ("eval", "export --object cup --format obj --resolution 8", "masks reproject", "masks check"):
        called("beags", *words.split(), "--load-config", config, "--data", tmp_path / "disk")
        assert words == "masks check" or (config.parent / COMMANDS[words]).exists()
    assert not (tmp_path / "lab").exists()


# -- nerfstudio's commands -------------------------------------------------------------------------------------------


def test_commands_of_nerfstudio_read_and_write_where_the_run_lies(moved, tmp_path, capsys, monkeypatch):
    from nerfstudio.scripts.eval import ComputePSNR
    from nerfstudio.scripts.exporter import ExportGaussianSplat
    from nerfstudio.scripts.render import DatasetRender
    from nerfstudio.utils.eval_utils import eval_setup

    before = files(tmp_path / "old")
    monkeypatch.setattr("sys.argv", ["ns-viewer", "--load-config", str(moved / "config.yml")])
    config, pipeline, checkpoint, _ = eval_setup(moved / "config.yml")  # all that ns-viewer takes from it
    assert config.get_base_dir() == moved and checkpoint.parent.parent == moved
    assert pipeline.datamanager.get_datapath() == moved  # camera paths go there
    assert f"trained in {tmp_path}/old/outputs/run" in capsys.readouterr().out
    ComputePSNR(moved / "config.yml", tmp_path / "psnr.json").main()
    assert json.loads((tmp_path / "psnr.json").read_text())["checkpoint"] == str(checkpoint)
    cup = moved / "extracted/cup"
    monkeypatch.setattr("sys.argv", ["ns-export", "gaussian-splat", f"--load_config={cup / 'config.yml'}"])
    ExportGaussianSplat(cup / "config.yml", tmp_path / "exported").main()
    with named(cup / "config.yml"):  # Python code names the file so.
        DatasetRender(load_config=cup / "config.yml", output_path=tmp_path / "pictures").main()
    assert (tmp_path / "exported/splat.ply").exists() and any((tmp_path / "pictures").rglob("*.jpg"))
    assert files(tmp_path / "old") == before


def test_commands_of_nerfstudio_refuse_a_copy_that_is_not_whole(moved, tmp_path):
    from nerfstudio.utils.eval_utils import eval_setup

    (tmp_path / "new/lab").rename(tmp_path / "new/photos")
    told = f"data of .*run/config.yml are not at {tmp_path}/old/lab: .* look at {moved}/"
    with named(moved / "config.yml"), pytest.raises(UserError, match=told):
        eval_setup(moved / "config.yml")
    shutil.rmtree(moved / "nerfstudio_models")
    with named(moved / "config.yml"), pytest.raises(UserError, match=f"{moved}/nerfstudio_models holds no checkpoint"):
        eval_setup(moved / "config.yml")


def test_trainings_go_where_the_run_lies(short_run, tmp_path):
    run, data = tmp_path / "copy", tmp_path / "photos"
    shutil.copytree(short_run / "run", run)
    shutil.copytree(short_run / "data", data)
    old = files(short_run)
    for steps, words in {
        20: (
            "ns-train",
            "beags-tiny",
            "--load-config",
            run / "config.yml",
            "--data",
            data,
            "--overwrite",
            "True",
        ),  # fmt: skip
        57: ("beags", "resume", run, "--data", data),
    }.items():
        text = (run / "config.yml").read_text()
        (run / "config.yml").write_text(re.sub("max_num_iterations: .*", f"max_num_iterations: {steps}", text))
        called(*words)
        assert checkpoint_of(run)["step"] == steps - 1
        assert open_run(run / "config.yml").data_path == data  # ns-train has written this place.
    assert files(short_run) == old and checkpoint_of(short_run / "run")["step"] == 56
