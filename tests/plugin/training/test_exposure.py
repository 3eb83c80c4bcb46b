"""Exposures of photos that are learned with the scene: when, from where, and what becomes of them."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("nerfstudio")
pytest.importorskip("beags_benchmarks", reason="it generates photos that differ in exposure")

from resumed_runs import (
    assert_same_run,
    checkpoint_of,
    interrupted,
    kill_at,
    resume_to_end,
    run_to_end,
    short_config,
)

from beags_benchmarks.samples.config import VariedSample
from beags_benchmarks.samples.exposure import photo_gains as true_gains
from beags_plugin.core.color_fit import apply_affine
from beags_plugin.core.exposure import Exposures
from beags_plugin.core.schedule import PhaseSchedule
from beags_plugin.objects.evaluate import evaluate_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.objects.photos import _image, photos_of
from beags_plugin.objects.shown import shown_scene
from beags_plugin.plugin.presets import preset_config
from beags_plugin.plugin.training.exposure import GAMMA, RATES, PhotoExposures, exposures_of_run, photo_gains
from beags_plugin.plugin.views.datamanager import BeagsDataManager, BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.runs.picked import write_picked
from beags_plugin.runs.read import read_run
from beags_plugin.runs.run import Run
from beags_plugin.sample.writer import write_sample
from beags_plugin.surfaces.color import srgb_from_linear
from beags_plugin.surfaces.frames import Frame
from beags_plugin.system.errors import UserError
from beags_plugin.views.photo_files import PhotoFiles

SAMPLE = VariedSample(width=56, height=42, num_train=10, num_test=2, num_points=600)
EXPOSED = {"exposure": 1.5}


def without_contacts(data: Path, run: Path, **options):
    """Return a short run that closes no contacts, which would take most of its time."""
    return short_config(data, run, **{"pipeline.model.close_contacts": False, **options})


@pytest.fixture(scope="module")
def folder(shared):
    """A function that writes the sample with options once; tests only read it."""

    @cache
    def written(**options) -> Path:
        name = "exposures-" + "-".join(f"{key}{value}" for key, value in options.items())
        return shared(name, lambda at: write_sample(at / "data", replace(SAMPLE, **options))) / "data"

    return written


@pytest.fixture(scope="module")
def whole(shared, folder):
    """A run of all phases with exposures, without a break; tests that change it copy it."""
    return shared("exposed_run", lambda at: run_to_end(without_contacts(folder(**EXPOSED), at / "run"))) / "run"


def manager_of(data: Path, **options) -> BeagsDataManager:
    config = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=data), **options)
    return BeagsDataManager(config, device="cpu", test_mode="val")


@dataclass
class Model:
    """Stand-in for a model, with what exposures ask of it."""

    exposure: str = "auto"
    exposures: Exposures | None = None
    device: str = "cpu"
    schedule: PhaseSchedule = field(default_factory=lambda: PhaseSchedule(base_steps=100, refine_steps=0))

    @property
    def config(self) -> Model:
        return self


def learned(data: Path, **options) -> PhotoExposures | None:
    return exposures_of_run(Model(**options), manager_of(data))


def changed(data: Path, to: Path, pixels) -> Path:
    """Copy a scene and replace the pixels of its first training photo; return the copy."""
    shutil.copytree(data, to)
    path = to / json.loads((to / "transforms.json").read_text())["train_filenames"][0]
    Image.fromarray(pixels(np.array(Image.open(path)))).save(path)
    return to


# -- which gains are found, and when they count ------------------------------------------------------------------------


@pytest.mark.parametrize("options", [EXPOSED, {"exposure": 1.0, "white_balance": 0.7}, {"family": "room", **EXPOSED}])
def test_gains_of_a_generated_scene(folder, options):
    """They are found from seed_tracks.json, to what a pixel that shows several surfaces leaves uncertain."""
    manager = manager_of(folder(**options))
    found = photo_gains(manager)
    stems = [[path.stem for path in each.image_filenames] for each in (manager.train_dataset, manager.eval_dataset)]
    of_photo = true_gains(*stems, SAMPLE.seed, options["exposure"], options.get("white_balance", 0.0))
    true = np.log2([of_photo[view.name] for view in manager.views("train")])
    assert found is not None and true.mean(axis=1).std() > 0.15
    assert np.abs(found.stops - true).max() < 0.2 and np.abs(found.stops - true).mean() < 0.07
    assert found.spread == pytest.approx(true.mean(axis=1).std(), abs=0.05)


def test_points_beside_a_photo_without_its_lens_do_not_count(folder, monkeypatch):
    manager = manager_of(folder(**EXPOSED))
    found, straightened = photo_gains(manager), PhotoFiles.straightened
    tracks = [(np.tile(ids, 2), np.tile(places, (2, 1))) for ids, places in manager.dataparser.tracks("train")]
    monkeypatch.setattr(manager.dataparser, "tracks", lambda split: [(ids[::-1], at) for ids, at in tracks])

    def beside(self, places, index):
        camera, xy = straightened(self, places, index)
        xy = xy[: len(xy) // 2]
        out = [-0.1, 1.0] if index % 2 else [1.0, camera.height]
        return camera, np.concatenate([np.full_like(xy, out), xy[::-1]])

    monkeypatch.setattr(PhotoFiles, "straightened", beside)
    assert np.array_equal(photo_gains(manager).stops, found.stops)


@pytest.mark.parametrize("family", ["tabletop", "room"])
def test_photos_that_are_alike_get_no_transforms(folder, family, capsys):
    data = folder(family=family)
    manager = manager_of(data)
    capsys.readouterr()
    assert exposures_of_run(Model(), manager) is None
    assert capsys.readouterr().out == ""
    assert learned(data, exposure="on") is not None


def test_photos_that_differ_get_transforms_and_one_line_says_so(folder, capsys):
    manager = manager_of(folder(**EXPOSED))
    found = photo_gains(manager)
    capsys.readouterr()
    own = exposures_of_run(Model(), manager)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"The photos differ in exposure by {found.spread:.2f} EV (standard deviation; ")
    assert "colours" not in line
    diagonal = own.affine.detach()[:, range(3), range(3)]
    assert torch.allclose(diagonal.mean(dim=0), torch.ones(3), atol=1e-6)
    ratios = 2.0 ** ((found.stops - found.stops[0]) / GAMMA)
    assert torch.allclose(diagonal / diagonal[0], torch.from_numpy(ratios).float(), atol=1e-5)
    light = torch.linspace(0.05, 0.3, 4, dtype=torch.float64).repeat(3, 1).T.numpy()
    for photo, slopes in enumerate(diagonal.double().numpy()):
        seen = apply_affine(torch.from_numpy(srgb_from_linear(light)), own.affine[photo].detach())
        factor = slopes**GAMMA
        assert torch.allclose(seen, torch.from_numpy(srgb_from_linear(light * factor)), atol=0.02), "a gain is affine"


def test_white_balances_alone_count(folder, capsys):
    manager = manager_of(folder(white_balance=0.7))
    capsys.readouterr()
    assert exposures_of_run(Model(), manager) is not None
    (line,) = capsys.readouterr().out.splitlines()
    assert "and their colours by 0.1" in line or "and their colours by 0.2" in line


def test_the_paper_knows_none(folder):
    assert preset_config("beags-paper", {}, Path("test")).model_config.exposure == "off"
    assert preset_config("beags-fast", {}, Path("test")).model_config.exposure == "auto"
    model = Model("off", Exposures(("a",), torch.eye(3, 4)[None]))
    assert exposures_of_run(model, manager_of(folder(**EXPOSED))) is None and model.exposures is None


@pytest.mark.parametrize(("options", "value"), [({}, 255), (EXPOSED, 0)])
def test_a_black_or_burnt_out_photo_is_named_and_training_goes_on(folder, tmp_path, capsys, options, value):
    data = changed(folder(**options), tmp_path / "data", lambda pixels: np.full_like(pixels, value))
    short = {"pipeline.model.base_steps": 12, "pipeline.model.refine_steps": 0}
    run_to_end(short_config(data, tmp_path / "run", **short))
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("The photo view_000 shows no point of the scene that is neither black nor burnt out") == 1
    assert (read_run(tmp_path / "run/config.yml").exposures is None) == (not options)


# -- what is learned, and what keeps it --------------------------------------------------------------------------------


def transforms_of(run: Path) -> Exposures:
    found = read_run(run / "config.yml").exposures
    assert found is not None
    return found


def test_transforms_are_learned_and_their_mean_stays_the_identity(folder, whole):
    start, found = learned(folder(**EXPOSED)).affine.detach(), transforms_of(whole)
    assert torch.allclose(found.affine.mean(dim=0), torch.eye(3, 4), atol=1e-6)
    moved = (found.affine - start).abs()
    assert moved.max() > 3e-3 and (moved.amax(dim=(1, 2)) > 1e-3).all()
    assert found.names == tuple(view.name for view in manager_of(folder(**EXPOSED)).views("train"))


def test_a_photo_is_pulled_towards_where_it_began():
    """Without a gradient of the loss, exposures that were moved go back, and the others stay where they were."""
    model = Model()
    own = PhotoExposures(model, Exposures(("a", "b"), torch.eye(3, 4).repeat(2, 1, 1)))
    with torch.no_grad():
        own.affine[0, 0, 3], own.affine[1, 0, 3] = 0.1, -0.1
    for step in range(8):
        (0.0 * own(torch.ones(2, 3), 0)).sum().backward()
        own.after_step(step)
    assert 0.0 < float(own.affine[0, 0, 3]) < 0.08
    assert model.exposures is not None and torch.equal(model.exposures.affine, own.affine.detach())


@pytest.mark.parametrize("count", [2, 200])
def test_how_far_a_photo_moves_does_not_hang_on_the_number_of_photos(count):
    own = PhotoExposures(Model(), Exposures(tuple(map(str, range(count))), torch.eye(3, 4).repeat(count, 1, 1)))
    for step in range(2 * count):  # It is seen twice.
        own(torch.full((2, 3), 0.5), step % count).sum().backward()
        own.after_step(step)
        if step == count - 1:
            once = own.steps.clone()
    assert (once == 1).all() and (own.steps == 2).all()
    before, moments = own.affine.detach().clone(), own.moments.clone()
    own(torch.full((2, 3), 0.5), 0).sum().backward()
    own.after_step(0)
    moved = own.affine.detach() - before
    assert torch.allclose(moved[0] - moved[1], torch.full((3, 4), -RATES[0]), rtol=1e-3)
    assert torch.equal(own.moments[:, 1:], moments[:, 1:])


@pytest.mark.parametrize("photos", ["all", "objects"])
def test_photos_without_tracks_get_transforms_only_where_they_are_wanted(folder, tmp_path, photos, capsys):
    data = shutil.copytree(folder(**EXPOSED), tmp_path / "data")
    (data / "seed_tracks.json").unlink()
    manager = manager_of(data, photos=photos)
    capsys.readouterr()
    assert photo_gains(manager) is None and exposures_of_run(Model(), manager) is None
    own = exposures_of_run(Model("on"), manager)
    assert own is not None and torch.equal(own.affine, torch.eye(3, 4).repeat(10, 1, 1))
    assert capsys.readouterr().out == ""


def test_objects_that_turn_in_a_standing_light_are_no_exposures(folder):
    manager = manager_of(folder(**EXPOSED), photos="objects")
    assert exposures_of_run(Model(), manager) is None
    inside, every = photo_gains(manager), photo_gains(manager_of(folder(**EXPOSED)))
    assert (inside.noise > every.noise).all(), "points on the background tell nothing"
    assert exposures_of_run(Model("on"), manager) is not None


def test_what_is_see_through_tells_no_exposure(folder):
    manager = manager_of(folder(**EXPOSED))
    cached = manager.cached_train[2]
    cached["alpha"] = torch.zeros(cached["image"].shape[:2], dtype=torch.uint8)
    found = photo_gains(manager)
    assert np.isinf(found.noise[2]) and np.isfinite(np.delete(found.noise, 2)).all()


def test_colours_are_those_that_the_photo_shows():
    affine = torch.eye(3, 4).repeat(2, 1, 1) + torch.arange(24.0).view(2, 3, 4) / 50
    own, colors = PhotoExposures(Model(), Exposures(("a", "b"), affine)), torch.rand(5, 3)
    expected = colors @ affine[1, :, :3].T + affine[1, :, 3]
    assert torch.allclose(own(colors, 1), expected, atol=1e-6)
    own(colors, 1).sum().backward()
    assert not own.affine.grad[0].any() and own.affine.grad[1].all()


@pytest.mark.parametrize(("step", "after"), [(20, True), (44, True), (50, False)])
@pytest.mark.slow("two trainings each")
def test_a_killed_run_ends_as_the_whole_one(folder, whole, tmp_path, monkeypatch, step, after):
    run, data = tmp_path / "run", folder(**EXPOSED)
    kept = {"pipeline.model.close_contacts": False}
    interrupted(data, run, monkeypatch, lambda patch: kill_at(patch, step, after), **kept)
    resume_to_end(run)
    assert_same_run(run, whole)
    part = checkpoint_of(run)["beags"]["parts"]["exposure"]
    assert part["moments"].flatten(2).any(dim=2).all() and int(part["steps"].sum()) == 57


def test_curves_and_evaluation_take_the_fit_for_exposures(whole, short_run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(whole))
    events.Reload()
    assert "Eval Images Metrics/psnr_fit" in events.Tags()["scalars"]
    found = evaluate_run(whole / "config.yml")
    assert found.before is not None and found.before.colors_fitted and found.after.colors_fitted
    assert not evaluate_run(short_run / "run/config.yml").after.colors_fitted


@pytest.mark.slow("two trainings each")
def test_the_number_of_threads_is_no_matter(folder, whole, tmp_path):
    before = torch.get_num_threads()
    torch.set_num_threads(2 if before == 1 else 1)
    try:
        run_to_end(without_contacts(folder(**EXPOSED), tmp_path / "run"))
    finally:
        torch.set_num_threads(before)
    assert_same_run(tmp_path / "run", whole)


def test_the_base_extracted_and_picked_runs_keep_them(whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    own = transforms_of(run)
    base = transforms_of(run / "base")
    assert base.names == own.names and not torch.equal(base.affine, own.affine)
    (extracted, *_) = extract_objects(run / "config.yml")
    assert torch.equal(transforms_of(extracted.config.parent).affine, own.affine)
    scene = read_run(run / "config.yml")
    write_picked(run, scene.state["gauss_params.means"], scene.members, scene.classes)
    assert torch.equal(transforms_of(run).affine, own.affine)


def test_textures_and_exports_get_photos_of_the_mean_exposure(whole):
    scene = read_run(whole / "config.yml")
    shown = shown_scene(Run(whole / "config.yml"))
    for view, name in enumerate(shown.names):
        (affine,) = (
            own for own, known in zip(scene.exposures.affine, scene.exposures.names, strict=True) if known == name
        )
        photo, evened = shown.photos[view].image, _image(shown, view, (slice(None), slice(None)))
        inside = ((evened > 0) & (evened < 1)).all(dim=-1)
        assert inside.float().mean() > 0.5 and (photo - evened).abs().max() > 0.01
        assert torch.allclose(apply_affine(evened, affine)[inside], photo[inside], atol=1e-4)


def test_burnt_out_pixels_are_no_colours_of_a_surface(whole):
    """Evened, the white of a bright photo would be a grey that no surface has."""
    scene = read_run(whole / "config.yml")
    shown = shown_scene(Run(whole / "config.yml"))
    part, images = scene.surfels().detach(), [view.image.clone() for view in shown.photos]
    images[2][5:9, 3:6] = 1.0
    burnt = [(image == 1.0).all(dim=2) for image in images]
    assert burnt[2].sum() >= 12
    for exposures in (shown.exposures, None):
        scene = replace(shown, exposures=exposures)
        vars(scene)["photos"] = [SimpleNamespace(image=image) for image in images]  # They are read only once.
        for view, photo in enumerate(photos_of(scene, None, part, Frame.of_run())):
            expected = ~burnt[view] if exposures is not None else torch.ones_like(burnt[view])
            assert torch.equal(photo.own(), expected)


def refined(data: Path, run: Path, base: Path, **options) -> Path:
    config = without_contacts(data, run, **{"pipeline.model.base_steps": 0, **options})
    config.load_dir, config.method_name = base / "nerfstudio_models", "beags-refine"
    run_to_end(config)
    return run


def test_refinement_goes_on_with_those_of_the_base(folder, whole, tmp_path, capsys):
    capsys.readouterr()
    run = refined(folder(**EXPOSED), tmp_path / "run", whole / "base")
    printed = capsys.readouterr().out
    assert "how long they take" in printed and "Quicker" not in printed  # Its steps are few already.
    assert "differ in exposure" not in printed
    begun = checkpoint_of(run)["beags"]["parts"]["exposure"]["start"]
    assert torch.equal(begun, transforms_of(whole / "base").affine)
    assert not torch.equal(transforms_of(run).affine, begun)


def test_a_base_of_before_begins_with_the_gains_of_its_points(folder, whole, tmp_path):
    base = shutil.copytree(whole / "base", tmp_path / "base")
    (path,) = (base / "nerfstudio_models").iterdir()
    content = torch.load(path, weights_only=True)
    del content["pipeline"]["_model._extra_state"]["exposures"]
    torch.save(content, path)
    assert read_run(base / "config.yml").exposures is None
    run = refined(folder(**EXPOSED), tmp_path / "run", base)
    assert torch.equal(checkpoint_of(run)["beags"]["parts"]["exposure"]["start"], learned(folder(**EXPOSED)).start)


def test_photos_that_the_base_did_not_know_begin_at_the_identity(folder):
    manager = manager_of(folder(**EXPOSED))
    names = [view.name for view in manager.views("train")]
    known = Exposures((names[3], "another"), 2 * torch.eye(3, 4).repeat(2, 1, 1))
    own = exposures_of_run(Model(exposures=known), manager)
    assert torch.equal(own.start[3], known.affine[0]) and torch.equal(own.start[4], torch.eye(3, 4))


def test_a_damaged_entry_is_told_in_one_sentence(whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    (path,) = (run / "nerfstudio_models").iterdir()
    content = torch.load(path, weights_only=True)
    content["pipeline"]["_model._extra_state"]["exposures"]["affine"][0, 0, 0] = float("nan")
    torch.save(content, path)
    with pytest.raises(UserError, match="the exposures of its photos are damaged.*name another, or train again"):
        read_run(run / "config.yml")
