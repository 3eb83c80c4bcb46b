"""``beags demo --pick``: base, viewer, refinement, each once; what is said where nothing was saved."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from data_folders import write_image
from run_folders import write_scene

from beags_plugin.commands import demo, demo_picks, demo_training
from beags_plugin.commands.cli import main
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.objects import picked_masks
from beags_plugin.runs.checkpoint_file import SAW_CLOSE_UPS
from beags_plugin.system.errors import UserError

SIZE = 12, 20  # height and width of the photos


class Stand:
    """A demo whose trainings and viewer only leave what says that they ended; said: the programs that were started."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.data = write_scene(root / "bear", masks=False)
        (self.data / "classes.json").unlink()
        self.output = root / "out"
        self.said: list[list[str]] = []
        self.saves, self.code, self.error = True, 0, None
        self.preset, self.downscale, self.mask = "beags-tiny", None, None
        self.saw, self.counted = False, []
        monkeypatch.setattr(demo_training, "finish", self.train)
        monkeypatch.setattr(demo_picks, "subprocess", SimpleNamespace(run=self.view))
        monkeypatch.setattr(demo, "measure", lambda *_: self.said.append(["measured"]))

    def train(self, words: list[str]) -> None:
        self.said.append(words)
        run = Path(words[words.index("--run-dir") + 1])
        (run / "base").mkdir(parents=True)
        (run / "nerfstudio_models").mkdir()
        parts = dict.fromkeys(("pipeline", "optimizers", "scalers"), {})
        torch.save({"step": 9, **parts, SAW_CLOSE_UPS: self.saw}, run / "nerfstudio_models/step-000000009.ckpt")
        (run / "base/config.yml").write_text(words[1])
        seconds = 0.0 if self.kind(words) == "refined" else 3.0
        (run / "training.json").write_text(json.dumps({"seconds": {"base training": seconds}}))

    def view(self, words: list[str], **_) -> SimpleNamespace:
        words = words[words.index("view") :]
        self.said.append(words)
        if self.error is not None:
            raise self.error
        if self.saves:
            folder = Path(words[words.index("--save-to") + 1])
            mask = np.full(SIZE, len(self.said) % 2, np.uint8) if self.mask is None else self.mask
            write_image(folder / "masks/v01.png", mask)
            (folder / "classes.json").write_text('{"1": "bear"}')
            (folder / picked_masks.STAMP).write_text(picked_masks._digest(folder))
        return SimpleNamespace(returncode=self.code)

    def apart(self, run, options, output, things, enlarge) -> list[str]:
        """Stand in for the separation of things."""
        self.said.append(["apart", str(run.config_path), str(options.masks), str(things), str(enlarge)])
        mask = np.full(SIZE, len(self.said) % 2, np.uint8) if self.mask is None else self.mask
        write_image(output / "masks/v01.png", mask)
        (output / "classes.json").write_text('{"1": "bear 1", "7": "bear 7", "8": "bear 8"}')
        return ["Only one thing lies apart"]

    def run(self, fresh: bool = False, pick: bool = True, objects: int = 1) -> list[str]:
        """Run the demo; return what was started, in a word each."""
        self.said.clear()
        demo.run_demo(self.data, self.output, self.preset, self.downscale, 0, fresh, pick=pick, objects=objects)
        return [self.kind(words) for words in self.said]

    @staticmethod
    def kind(words: list[str]) -> str:
        if "--load-dir" in words:
            return "refined"
        return "base" if "--pipeline.model.refine-steps" in words else "both" if len(words) > 9 else words[0]


@pytest.fixture
def stand(tmp_path, monkeypatch) -> Stand:
    return Stand(tmp_path, monkeypatch)


def test_base_viewer_and_refinement_follow_one_another_and_each_is_done_once(stand, capsys):
    assert stand.run() == ["base", "view", "refined", "measured"]
    again = f"beags demo --data {stand.data} --output {stand.output} --preset beags-tiny --pick --fresh"
    assert capsys.readouterr().out.endswith(f"pick them again on the same base:\n    {again}\n")
    base, view, refined, _ = stand.said
    assert base[base.index("--pipeline.model.refine-steps") + 1] == "0"
    pick = stand.output / "pick"
    assert view == ["view", str(pick / "run"), "--save-to", str(pick), "--expect", "bear"]
    assert refined[refined.index("--load-dir") + 1] == str(pick / "run/nerfstudio_models")
    assert refined[refined.index("--pipeline.model.base-steps") + 1] == "0"
    assert refined[refined.index("--masks-path") + 1] == str(pick / "masks")
    assert refined[refined.index("--classes-path") + 1] == str(pick / "classes.json")
    assert stand.run() == ["measured"]
    assert stand.run(fresh=True) == ["view", "refined", "measured"]  # picked again, on the same base
    assert stand.run() == ["measured"]


@pytest.fixture
def small(stand, monkeypatch) -> Stand:
    """A demo in whose photos, which are scaled down, the picked object is small; counted: seconds of each call."""
    monkeypatch.setattr(demo, "measure", lambda run, output, seconds, *_: stand.counted.append(dict(seconds)))
    stand.downscale, stand.mask = 2.0, np.zeros(SIZE, np.uint8)
    stand.mask[4:8, 4:10] = 1
    return stand


def test_close_ups_of_a_small_object_need_a_training_with_its_masks_from_the_beginning(small, capsys):
    assert small.run() == ["base", "view", "both"]
    out = capsys.readouterr().out
    assert "Training starts again, now with close-ups" in out and "layout" not in out
    words = small.said[2]
    assert words[words.index("--masks-path") + 1] == str(small.output / "pick/masks")
    assert small.run() == [] and "close-ups" not in capsys.readouterr().out
    assert [each["base training"] for each in small.counted] == [6.0, 6.0]  # seconds of both bases
    small.mask[:8] = 1
    assert small.run(fresh=True) == ["view", "refined"]
    assert "close-ups" not in capsys.readouterr().out and small.counted[-1]["base training"] == 3.0


def test_a_training_with_close_ups_that_was_interrupted_is_resumed(small, monkeypatch, capsys):
    train = small.train

    def interrupted(words: list[str]) -> None:
        train(words)
        run = Path(words[words.index("--run-dir") + 1])
        if small.kind(words) == "both":
            (run / "training.json").unlink()
            (run / "config.yml").write_text("")
            raise KeyboardInterrupt

    monkeypatch.setattr(demo_training, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        small.run()
    capsys.readouterr()

    def resumed(words: list[str]) -> None:
        small.said.append(words)
        (small.output / "run/training.json").write_text(json.dumps({"seconds": {"base training": 3.0}}))

    monkeypatch.setattr(demo_training, "finish", resumed)
    small.run()
    out = capsys.readouterr().out
    assert small.said[-1][-2:] == ["resume", str(small.output / "run")]
    assert "Resuming the training" in out and "close-ups" not in out and small.counted[-1]["base training"] == 6.0


def test_a_preset_without_close_ups_refines_the_base(small):
    small.preset = "beags-paper"
    assert small.run() == ["base", "view", "refined"]


@pytest.fixture
def separated(stand, monkeypatch) -> None:
    """A network marks all of each photo, and ``Stand.apart`` separates things."""
    monkeypatch.setattr("beags_plugin.masks.sources.salient.load", lambda _: lambda photo: photo[..., 0] > -1)
    monkeypatch.setattr("beags_plugin.commands.scene_setup.check_source", lambda chosen: None)
    monkeypatch.setattr("beags_plugin.objects.agree_masks.agree_masks", stand.apart)


@pytest.mark.parametrize(("saw", "training"), [(False, "both"), (True, "refined")])
@pytest.mark.usefixtures("separated")
def test_things_that_lie_apart_are_trained_again_unless_the_base_saw_close_ups(small, saw, training):
    small.saw = saw
    assert small.run(pick=False, objects=3) == ["base", "apart", training]


@pytest.mark.usefixtures("separated")
def test_things_that_lie_apart_are_told_apart_on_the_base_and_masks_of_them_that_were_mended_stay(stand, capsys):
    assert stand.run(pick=False, objects=3) == ["base", "apart", "refined", "measured"]
    assert "Only one thing lies apart" in capsys.readouterr().out
    base, apart, refined, _ = stand.said
    assert "--pipeline.model.prepare.agree" not in base + refined
    assert apart[1:] == [str(stand.output / "pick/run/config.yml"), str(stand.output / "made/masks"), "3", "True"]
    assert refined[refined.index("--masks-path") + 1] == str(stand.output / "apart/masks")
    assert stand.run(pick=False, objects=3) == ["measured"]
    with pytest.raises(UserError, match=r"that was trained with --objects 3: add --fresh to replace it \(its base is"):
        stand.run(pick=False, objects=2)
    assert stand.run(True, pick=False, objects=2) == ["apart", "refined", "measured"]
    write_image(stand.output / "apart/masks/v01.png", np.full(SIZE, 7, np.uint8))
    assert stand.run(True, pick=False, objects=3) == ["refined", "measured"]
    assert "were mended, so they stay" in capsys.readouterr().out
    mended = {stand.output / f"{name}/masks/v01.png": name for name in ("made", "apart")}
    for path, name in mended.items():
        write_image(path, np.full(SIZE, 8, np.uint8))
        (path.parents[1] / f"{name}.json").write_text("{")  # a damaged stamp
    assert stand.run(True, pick=False, objects=3) == ["refined", "measured"]
    assert all(np.unique(read_id_mask(path)).tolist() == [8] for path in mended)


def test_masks_that_nobody_made_here_hold_no_things_to_tell_apart(stand):
    write_image(stand.data / "masks/v01.png", np.full(SIZE, 1, np.uint8))
    with pytest.raises(UserError, match=r"are not a network's .* leave --objects out, or add --pick\."):
        stand.run(pick=False, objects=2)
    assert stand.said == []


def test_several_objects_are_expected_under_names_that_tell_them_apart(stand):
    stand.run(objects=3)
    assert stand.said[1][-4:] == ["--expect", "bear 1", "bear 2", "bear 3"]


def test_a_viewer_that_is_closed_without_saving_is_opened_again_by_the_next_call(stand):
    stand.saves = False
    with pytest.raises(
        UserError, match=r"nothing was saved .* The base stays; go on with:\n    beags demo --data "
    ) as end:
        stand.run()
    assert str(end.value).endswith(f"--output {stand.output} --preset beags-tiny --pick")
    assert not (stand.output / "run").exists()
    stand.saves = True
    assert stand.run() == ["view", "refined", "measured"]
    stand.saves = False
    with pytest.raises(UserError, match="nothing was saved"):
        stand.run(fresh=True)
    assert stand.run() == ["measured"]  # former picks are taken


def test_a_viewer_that_is_interrupted_or_fails_tells_how_to_go_on(stand, capsys):
    stand.error = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        stand.run()
    assert "Nothing was saved in the viewer. The base stays; go on with:\n    beags demo" in capsys.readouterr().out
    stand.error, stand.code = None, 3
    with pytest.raises(UserError, match=r"viewer ended with exit code 3; .* go on with:\n    beags demo .* --pick"):
        stand.run()


def test_masks_that_were_mended_after_picking_stay(stand, capsys):
    stand.run()
    write_image(stand.output / "pick/masks/v01.png", np.full(SIZE, 1, np.uint8))
    write_image(stand.output / "pick/masks/v02.png", np.full(SIZE, 1, np.uint8))
    assert stand.run(fresh=True) == ["refined", "measured"]
    assert "were mended, so they stay" in capsys.readouterr().out


def test_the_base_of_a_demo_without_picks_is_used_again_and_its_run_is_replaced_only_if_asked_for(stand, monkeypatch):
    monkeypatch.setattr("beags_plugin.masks.sources.salient.load", lambda _: lambda photo: photo[..., 0] > -1)
    monkeypatch.setattr("beags_plugin.commands.scene_setup.check_source", lambda chosen: None)
    assert stand.run(pick=False) == ["both", "measured"]
    kept = (stand.output / "run/base/config.yml").read_text()
    with pytest.raises(UserError, match=r"out/run holds a run that was trained without --pick: add --fresh"):
        stand.run()
    assert stand.said == [] and (stand.output / "run/training.json").exists()
    assert stand.run(fresh=True) == ["view", "refined", "measured"]
    assert (stand.output / "pick/run/config.yml").read_text() == kept
    with pytest.raises(UserError, match=r"trained with --pick: add --fresh"):
        stand.run(pick=False)
    shutil.rmtree(stand.output / "pick")
    assert stand.run(fresh=True)[0] == "base"  # The picked run's base is not reused.


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--pick"], "there is nothing to pick, as the sample has masks: name photos with --data."),
        (["--data", ".", "--pick", "--objects", "0"], "objects is 0: give 1 or more."),
        (["--data", ".", "--pick", "--strict"], "leave --strict out."),
        (["--objects", "3"], "the sample has masks of its objects: name photos with --data, or leave --objects out."),
    ],
)
def test_options_that_do_not_go_together_are_refused_at_once(tmp_path, monkeypatch, capsys, words, sentence):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["demo", *words])
    assert end.value.code == 2 and sentence in " ".join(capsys.readouterr().out.split())
    assert not list(tmp_path.iterdir())
