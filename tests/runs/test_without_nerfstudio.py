"""Finished runs are read without nerfstudio and torchvision, and as nerfstudio reads them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import torch
import yaml

pytest.importorskip("nerfstudio")

from run_folders import write_prepared, write_scene, write_trained

from beags_plugin.commands.cli import main
from beags_plugin.plugin.options.saved_config import load_run_config, open_for_training
from beags_plugin.runs.relocation import open_run
from beags_plugin.runs.run_config import read_run_config
from beags_plugin.runs.write import write_run
from beags_plugin.system.errors import UserError

COMMANDS = [
    "extract --load-config {run}",
    "export --load-config {run} --all --format ply obj --resolution 8",
    "export --load-config {run} --object cup --format glb --resolution 8",
    "eval --load-config {run}",
    "render --load-config {run} --object cup --format sheet --size 32 --views 2",
    "masks reproject --load-config {run}",
    "masks check --load-config {run} --output {tmp}/checked",
    "doctor --data {data}",
]
CALL = """
import contextlib, io, json, sys
from beags_plugin.commands.cli import main
from beags_plugin.commands.doctor import backends
backends.TRIAL = ""  # the doctor tries each rasterizer in a process of its own
for words in json.loads(sys.argv[1]):
    code = 0
    with contextlib.redirect_stdout(io.StringIO()) as said:
        try:
            main(words)
        except SystemExit as ended:
            code = ended.code or 0
    # The check of masks says by 1 that it found errors.
    assert code == 0 or (code == 1 and words[:2] == ["masks", "check"]), f"beags {' '.join(words)}: {said.getvalue()}"
    found = {name.split(".")[0] for name in sys.modules} & {"nerfstudio", "torchvision"}
    assert not found, f"beags {' '.join(words)} imports {found}"
print("none")
"""


@pytest.fixture
def config(tmp_path) -> Path:
    return write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))


def test_no_command_on_a_finished_run_imports_nerfstudio(config, tmp_path):
    write_prepared(config.parent)
    lines = [each.format(run=config, tmp=tmp_path, data=tmp_path / "lab").split() for each in COMMANDS]
    done = subprocess.run([sys.executable, "-c", CALL, json.dumps(lines)], capture_output=True, text=True)
    assert done.stdout.strip() == "none", done.stderr
    exported = "exports/cup.obj", "exports/cup.glb"
    for made in ("extracted/cup/cup.ply", *exported, "renders/cup_sheet.png", "reprojected/report.json"):
        assert (config.parent / made).exists()
    assert (tmp_path / "checked/report.json").exists()


def test_a_config_is_the_same_with_and_without_nerfstudio(config):
    whole, plain = load_run_config(config), read_run_config(config)
    for name in ("get_base_dir", "get_checkpoint_dir"):
        assert getattr(plain, name)() == getattr(whole, name)()
    assert plain.data_path == whole.data_path and plain.method_name == whole.method_name
    for one, other in (
        (plain.model_config, whole.model_config),
        (plain.data_config, whole.data_config),
        (plain.data_config.dataparser, whole.data_config.dataparser),
    ):
        for each in fields(one):
            if each.name != "dataparser":
                assert getattr(one, each.name) == getattr(other, each.name), each.name


def test_a_run_written_without_nerfstudio_is_read_with_it(config, tmp_path):
    state = {"means": torch.zeros(1)}
    made = write_run(open_run(config), tmp_path / "plain/run", state, 3)
    whole = write_run(open_for_training(config), tmp_path / "whole/run", state, 3)
    one, other = (yaml.dump(load_run_config(path)) for path in (made, whole))
    assert one == other.replace(str(tmp_path / "whole"), str(tmp_path / "plain")).replace("- whole\n", "- plain\n")
    assert load_run_config(made).get_base_dir() == tmp_path / "plain/run"


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("!!python/name:beags_plugin.plugin.trainer.BeagsTrainer ''", "!!python/name:os.system ''", "names os.system"),
        ("!!python/object:nerfstudio.configs.base_config.MachineConfig", "!!python/object:os.Machine", "names os.Mach"),
        (".options.stages.Den", ".options.gone.Den", "older"),
        ("run_format: 3", "run_format: 2", "older version"),
    ],
)
def test_what_no_run_needs_is_refused(config, old, new, told):
    text = config.read_text()
    assert old in text
    config.write_text(text.replace(old, new))
    with pytest.raises(UserError, match=told):
        read_run_config(config)


def test_a_run_with_options_that_are_gone_still_opens(config, tmp_path):
    text = config.read_text()
    older = re.sub(r"(\n +)(scale_factor|stream): ", r"\1scene_scale: 2.0\1stream_above_gb: 0.1\1\2: ", text)
    assert older.count("stream_above_gb") == 2
    config.write_text(older)
    assert read_run_config(config).model_config.near == load_run_config(config).model_config.near
    main(["eval", "--load-config", str(config), "--json", str(tmp_path / "eval.json")])
    assert (tmp_path / "eval.json").exists()
    made = write_run(open_run(config), tmp_path / "part", {}, 3)
    assert load_run_config(made).model_config.near == 0.01


def test_a_run_centred_as_no_longer_possible_is_refused_in_one_sentence(config, capsys):
    text = config.read_text()
    assert "center_method: none" in text
    config.write_text(text.replace("center_method: none", "center_method: focus"))
    with pytest.raises(SystemExit):
        main(["eval", "--load-config", str(config)])
    assert "center_method is 'focus', which is gone: train again, or use the version" in capsys.readouterr().out
