"""``beags demo`` before and around the training."""

from __future__ import annotations

import contextlib
import itertools
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from data_folders import write_image, write_transforms
from run_folders import write_scene

from beags_plugin.commands import demo, demo_training
from beags_plugin.commands.cli import main
from beags_plugin.commands.demo import check_preset
from beags_plugin.commands.demo_training import STAMP, trained
from beags_plugin.plugin.options.config import base_config
from beags_plugin.sample import writer
from beags_plugin.system.errors import UserError
from beags_plugin.views.quick import QUICK_PIXELS, quick_downscale


def test_large_images_are_scaled_down_by_a_whole_factor(tmp_path):
    assert quick_downscale(tmp_path) == 1.0  # it cannot be read
    write_transforms(tmp_path)
    for path in (tmp_path / "images").iterdir():
        write_image(path, np.zeros((240, 400), np.uint8))
    assert quick_downscale(tmp_path) == 2.0  # 200 x 120 are 24,000 pixels
    (tmp_path / "images/v00.png").write_text("no picture")
    with pytest.raises(UserError, match="cannot be read as an image"):
        quick_downscale(tmp_path)


def test_the_images_that_the_layout_takes_decide(tmp_path):
    """LLFF takes the largest copies, not those whose folder comes first by name."""
    for name in ("a", "b"):
        for folder, shape in (("images_8", (750, 1000)), ("images_16", (375, 500))):
            write_image(tmp_path / f"{folder}/{name}.png", np.zeros(shape, np.uint8))
    poses = [np.column_stack([np.eye(3), [x, 0.0, 0.0], [1500.0, 2000.0, 1800.0]]) for x in (0.0, 1.0)]
    np.save(tmp_path / "poses_bounds.npy", np.array([[*pose.ravel(), 1.0, 2.0] for pose in poses]))
    assert quick_downscale(tmp_path) == 4.0  # 250 x 187 are 46,750 pixels


def test_only_presets_of_both_phases_make_a_demo():
    check_preset("beags-tiny")
    with pytest.raises(UserError, match="'beags-huge'"):
        check_preset("beags-huge")
    for preset in ("beags-base", "beags-refine"):
        with pytest.raises(UserError, match="compares a base with its refinement"):
            check_preset(preset)


def test_a_run_that_is_not_the_demos_is_kept(tmp_path):
    data, run = write_scene(tmp_path / "data"), tmp_path / "out/run"
    run.mkdir(parents=True)
    (run / "notes.txt").write_text("mine")
    for fresh in (False, True):
        with pytest.raises(UserError, match="out/run is not the demo's"):
            demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, fresh)
    assert sorted(path.relative_to(tmp_path).as_posix() for path in (tmp_path / "out").rglob("*")) == [
        "out/run", "out/run/notes.txt",
    ]  # fmt: skip


def test_a_damaged_stamp_means_not_trained(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/training.json").write_text("{}")
    assert not trained(tmp_path, {"preset": "beags-tiny"})
    (tmp_path / STAMP).write_text("{")
    assert not trained(tmp_path, {"preset": "beags-tiny"})
    (tmp_path / STAMP).write_text(json.dumps({"preset": "beags-tiny"}))
    assert trained(tmp_path, {"preset": "beags-tiny"})


def test_a_demo_that_was_killed_goes_on(tmp_path, monkeypatch):
    """A demo killed in the training resumes; after the training, it measures; another request asks first."""
    data, output = write_scene(tmp_path / "data"), tmp_path / "out"
    run, commands, measured = output / "run", [], []

    def process(command, **_):
        (word,) = {"resume", "ns-train"} & {Path(part).name for part in command}
        commands.append(word)
        run.mkdir(exist_ok=True)
        (run / "config.yml").touch()
        if len(commands) == 2:
            raise KeyboardInterrupt
        if len(commands) > 2:
            (run / "training.json").write_text("{}")
        return SimpleNamespace(returncode=9 if len(commands) == 1 else 0)

    def measure(*_):
        measured.append(len(commands))
        if len(measured) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(demo_training.subprocess, "run", process)
    monkeypatch.setattr(demo, "measure", measure)

    def again(downscale=None, fresh=False):
        with contextlib.suppress(KeyboardInterrupt, UserError):
            demo.run_demo(data, output, "beags-tiny", downscale, 0, fresh)
        return commands[-1], len(commands)

    assert again() == ("ns-train", 1)  # This one fails.
    assert again() == ("resume", 2)  # This one is killed.
    assert again() == ("resume", 3) and measured == [3]  # Then the demo is killed.
    assert again() == ("resume", 3) and measured == [3, 3]
    with pytest.raises(UserError, match=r"out/run holds a run that was trained with --downscale 1.0: add --fresh"):
        demo.run_demo(data, output, "beags-tiny", 2.0, 0, False)
    assert len(commands) == 3 and (run / "training.json").exists()
    assert again(downscale=2.0, fresh=True) == ("ns-train", 4)
    assert again(fresh=True) == ("ns-train", 5) and again() == ("ns-train", 5)


def test_the_generated_scene_is_photos_of_a_desk(tmp_path, monkeypatch):
    made, commands = [], []

    def make_sample(folder, config):
        made.append(config)
        write_scene(folder)

    monkeypatch.setattr(writer, "make_sample", make_sample)
    monkeypatch.setattr(demo_training, "finish", commands.append)
    monkeypatch.setattr(demo, "measure", lambda *_: None)
    demo.run_demo(None, tmp_path / "out", None, None, 4, False)
    (config,), (command,) = made, commands
    config.check()
    assert (config.family, config.seed) == ("desk", 4) and config.width >= 640 and config.height >= 480
    whole = config.width * config.height / float(command[command.index("--downscale-factor") + 1]) ** 2
    assert 0.9 * QUICK_PIXELS < whole <= QUICK_PIXELS


def test_photos_of_a_turntable_are_trained_on_again_by_their_objects(tmp_path, monkeypatch):
    """Once: a second demo takes what was trained, or resumes it."""
    data, run, commands = write_scene(tmp_path / "data"), tmp_path / "out/run", []

    def finish(command):
        commands.append(command)
        (run / "prepared").mkdir(parents=True, exist_ok=True)
        if "all" in command:
            (run / "prepared/report.json").write_text(json.dumps({"residuals": {"contradict": True}}))
        elif "objects" in command:
            (run / "config.yml").touch()
            raise KeyboardInterrupt
        (run / "training.json").write_text("{}")

    monkeypatch.setattr(demo_training, "finish", finish)
    monkeypatch.setattr(demo, "measure", lambda *_: None)

    def again() -> list[str]:
        commands.clear()
        with contextlib.suppress(KeyboardInterrupt):
            demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, False)
        return [word for command in commands for word in command if word in ("all", "objects", "resume")]

    assert again() == ["all", "objects"]
    assert again() == ["resume"]
    assert again() == []


def left_out_of(command: list[str]) -> list[str]:
    """Return the photos that a training leaves out."""
    after = command[command.index("--leave-out") + 1 :] if "--leave-out" in command else []
    return list(itertools.takewhile(lambda word: not word.startswith("--"), after))


def test_photos_with_wrong_poses_are_left_out_of_another_training(tmp_path, monkeypatch):
    """Once: a second demo takes what was trained, or resumes it; and with --fresh it looks again."""
    data, run, commands, scenes = write_scene(tmp_path / "data"), tmp_path / "out/run", [], []
    wrong, killed = ["v01", "v05"], [True]

    def finish(command):
        commands.append(command)
        (run / "prepared").mkdir(parents=True, exist_ok=True)
        (run / "config.yml").touch()
        views = [{"view": f"v{view:02d}"} for view in range(1, 8) if f"v{view:02d}" not in left_out_of(command)]
        report = {"views": views, "misplaced": [] if len(views) < 7 else wrong}
        (run / "prepared/report.json").write_text(json.dumps({"agreement": report}))
        if left_out_of(command) and killed:
            killed.pop()
            raise KeyboardInterrupt
        (run / "training.json").write_text("{}")

    monkeypatch.setattr(demo_training, "finish", finish)
    monkeypatch.setattr(demo, "measure", lambda *words: scenes.append(words[3]))

    def again(fresh: bool = False) -> list[object]:
        commands.clear()
        with contextlib.suppress(KeyboardInterrupt):
            demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, fresh)
        return ["resume" if "resume" in command else left_out_of(command) for command in commands]

    assert again() == [[], wrong] and scenes == []
    assert again() == ["resume"] and scenes[-1].without == ("v01", "v05")
    assert again() == [] and scenes[-1].without == ("v01", "v05")
    assert again(fresh=True) == [[], wrong]
    wrong[:] = ["v01"]
    assert again(fresh=True) == [[]] and scenes[-1].without == (), "one photo is not worth a training"
    wrong[:] = ["v01", "v02", "v03"]
    assert again(fresh=True) == [[]], "of so many it is not clear which are wrong"


def test_a_demo_that_is_under_way_is_left_alone(tmp_path):
    from beags_plugin.system.lock import run_lock

    data, run = write_scene(tmp_path / "data"), tmp_path / "out/run"
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / STAMP).write_text("{}")
    lock = run_lock(run)
    with pytest.raises(UserError, match="being trained by another process"):
        demo.run_demo(data, tmp_path / "out", "beags-tiny", None, 0, True)
    assert run.is_dir()
    lock.release()


def test_brackets_in_a_path_are_no_markup(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["demo", "--data", str(tmp_path / "x[/y]")])
    assert end.value.code == 2
    assert "x[/y] does not exist" in capsys.readouterr().out.replace("\n", "")


def test_a_saved_run_names_its_folder_absolutely(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = base_config()
    config.run_dir = config.output_dir / "mine"
    assert not config.run_dir.is_absolute()
    config.get_base_dir().mkdir(parents=True)
    config.save_config()
    assert config.run_dir == tmp_path / "outputs" / "mine"
    assert (config.run_dir / "config.yml").exists()
