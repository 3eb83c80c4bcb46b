"""Refiners that own their training start from a base with exact Gaussians and classes: edits, steps, objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

pytest.importorskip("nerfstudio")

from resumed_runs import checkpoint_of, run_to_end, short_config
from run_folders import discs, write_drawn_scene, write_trained

from beags_plugin.core.densification import Densified
from beags_plugin.core.surfels import Surfels
from beags_plugin.objects.evaluate import evaluate_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.plugin.training import refinement
from beags_plugin.runs.read import read_run

pytestmark = pytest.mark.slow("a training for each choice of options")

SURFELS, CLASS_IDS = discs()


@dataclass
class Refined:
    """A run, its edits as one, and for each edit the numbers of Gaussians before it, of those gone and of children."""

    config: Path
    edited: Densified
    edits: list[tuple[int, int, int]]

    @property
    def adam_steps(self) -> set[float]:
        state = checkpoint_of(self.config.parent)["optimizers"]["scene"]["state"]
        return {float(each["step"]) for each in state.values()}

    def jaccard(self, class_id: int) -> float:
        """Return the Jaccard index of the object and the Gaussians that come from its discs."""
        found, true = read_run(self.config).members.of(class_id), CLASS_IDS[self.edited.source] == class_id
        return int((found & true).sum()) / int((found | true).sum())


@pytest.fixture(scope="module")
def refined(tmp_path_factory):
    """A function that refines the discs with a refiner and its options."""
    root, made = tmp_path_factory.mktemp("own"), {}
    write_drawn_scene(root / "data")
    write_trained(root / "discs", root / "data", assigned=False, base=False)

    def run(name: str, **options) -> Refined:
        folder = root / "-".join(map(str, (name, *options.values())))
        if folder in made:
            return made[folder]
        whole, edits, apply = [Densified.unchanged(SURFELS)], [], refinement.apply_edit

        def noted(model, adam, edit) -> None:
            if edit is not None and edit.edited is not None:
                e = edit.edited
                count = model.num_points
                edits.append((count, count - len(torch.unique(e.source)), int(e.fresh.sum())))
                whole.append(whole.pop().then(e))
            apply(model, adam, edit)

        settings = {
            "refiner": name,
            "refiner_options": options,
            "prepare.reprojection": "none",
            "start_from": root / "discs",
            "start_frame": "world",
            "base_steps": 1,
            "background_color": "black",
        }
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(refinement, "apply_edit", noted)
            model = {f"pipeline.model.{key}": value for key, value in settings.items()}
            run_to_end(short_config(root / "data", folder, **model))
        made[folder] = Refined(folder / "config.yml", whole[0], edits)
        return made[folder]

    return run


def scene_of(run: Refined) -> tuple[Surfels, Surfels]:
    """Return the base and the final scene."""
    return read_run(run.config.parent / "base/config.yml").surfels(), read_run(run.config).surfels()


def test_trace3d_leaves_the_centres_of_those_that_it_does_not_split(refined):
    run = refined("trace3d")
    base, after = scene_of(run)
    source, fresh = run.edited.source, run.edited.fresh
    assert len(after) == len(source) > 60 and 10 <= int(fresh.sum()) <= 20
    assert torch.equal(after.means[~fresh], base.means[source[~fresh]])
    assert not (after.means[fresh] == base.means[source[fresh]]).all(dim=1).any()
    assert (after.log_scales != base.log_scales[source]).any(dim=1).all(), "everything else trains on"
    run = refined("trace3d", position_lr="intended")
    base, after = scene_of(run)
    kept = ~run.edited.fresh
    assert (after.means[kept] != base.means[run.edited.source[kept]]).any(dim=1).all()


def test_trace3d_splits_prunes_and_takes_the_objects(refined):
    run = refined("trace3d")
    assert len(run.edits) == 5 and run.edits[0][2] >= 10 and run.edits[-1][1:] == (0, 0)
    assert run.adam_steps == {7.0}, "Adam starts anew; five of 12 steps come before edits and are lost"
    members, found = read_run(run.config).members, evaluate_run(run.config)
    assert members.objects is None and [run.jaccard(c) > 0.9 for c in (1, 2)] == [True, True]
    assert found.before is not None and found.before.psnr > found.after.psnr > 30
    assert all(found.after.objects[c].extracted.iou > 0.38 for c in (1, 2)), "masks are wider than half-opaque things"


def test_cob_gs_cuts_the_objects_in_turn(refined):
    run = refined("cob-gs", epochs=6)
    (first, second, last) = run.edits
    assert first[0] == 75 and first[2] > 20 and second[1] > 0 and second[2] > 0 and last[1] > 0 == last[2]
    assert run.adam_steps == {14.0}, "Adam starts anew for the second object"
    assert read_run(run.config).members.present() == [0, 1, 2]
    assert all(run.jaccard(c) > 0.8 for c in (1, 2))
    found = evaluate_run(run.config)
    assert found.before is not None and found.before.psnr > found.after.psnr > 25


def test_cob_gs_cuts_one_object_out_of_a_scene_of_its_own(refined):
    run = refined("cob-gs", epochs=6, object="cup")
    assert len(run.edits) == 2 and run.edits[0][2] > 20 and run.edits[1][1] > 0
    assert run.adam_steps == {15.0}, "it goes on from the base, which had one step"
    assert read_run(run.config).members.present() == [0, 1] and run.jaccard(1) > 0.8
    (cup,) = extract_objects(run.config, ["cup"])
    assert cup.gaussians == int(read_run(run.config).members.of(1).sum()) > 20
