"""The tab Pick in nerfstudio's own viewer, without a browser: its work, its messages and its files."""

from __future__ import annotations

import base64
import json
import re
import shlex
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import tyro
from PIL import Image
from solid_runs import COLOURED, POINTS, write_solids, write_solids_run
from touching_solids import SETTINGS, overlap, solids, views

pytest.importorskip("nerfstudio")

from clicked_pages import VIEW, click_on, page, position
from run_folders import ring_cameras
from viewer_windows import Window, told, wait_until
from written_splats import read_ply

from beags_plugin.labels.classes import read_id_mask
from beags_plugin.labels.colors import colorize
from beags_plugin.objects.export import export_run
from beags_plugin.objects.extract import extract_objects
from beags_plugin.objects.picked_masks import option_words
from beags_plugin.picking.picks import Picked, Picks
from beags_plugin.plugin.viewer.legend import pasteable
from beags_plugin.plugin.viewer.other_sides import other_sides
from beags_plugin.plugin.viewer.pick_work import FIRST_COLOR
from beags_plugin.plugin.viewer.pointing import page_camera
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.runs.picked import PICKED_FILE
from beags_plugin.runs.read import read_run
from beags_plugin.splat_io.frames import read_transform
from beags_plugin.splat_io.ply import write_ply
from beags_plugin.system.errors import UserError


@pytest.fixture
def opened(tmp_path):
    """Yield what opens the viewer of a run of the solids, and closes it in the end."""
    windows = []

    def open_run(assigned: bool = False, config=None):
        if config is None:
            config, _ = write_solids_run(tmp_path / "run", write_solids(tmp_path / "lab"), assigned)
        windows.append(Window(config))
        return windows[-1].panel.pick_tab, config

    yield open_run
    for window in windows:
        window.close()


def click(tab, point, text: str, exclude: bool = False) -> str:
    """Click on a point of the world, and wait for what the panel says."""
    tab.excludes.value, tab.note = exclude, ""
    tab.clicked(click_on(point))
    return told(tab, text)


def press(tab, action, text: str) -> str:
    tab.note = ""
    action()
    return told(tab, text)


OWNER = solids(COLOURED)[1]


def test_a_page_sees_what_the_view_sees():
    camera = page_camera(page())
    assert (camera.viewmat - VIEW.viewmat).abs().max() < 1e-5


def test_clicks_paint_the_object_and_are_undone(opened):
    tab, config = opened()
    viewing = tab.viewing
    assert "(" in click(tab, POINTS["low"], "Gaussians") and overlap(tab.work.picks.chosen.members, OWNER == 1) > 0.95
    painted = viewing.paint
    assert torch.equal(painted.strength > 0, tab.work.picks.chosen.members) and painted.only is None
    assert "Nothing has been changed" in click(tab, POINTS["low"], "contradicts", exclude=True)
    assert viewing.paint.strength.equal(painted.strength)
    assert "fewer" in press(tab, lambda: tab._grow(-8), "Gaussians")
    press(tab, tab.work.undo, "Gaussians")
    assert tab.work.picks.chosen.growth == 0
    press(tab, tab.work.undo, "nothing yet")
    press(tab, tab.work.undo, "Nothing has been changed")
    assert viewing.paint is None


def test_a_cut_of_more_than_half_of_the_scene_is_said(opened):
    tab, _ = opened()
    assert "half of the scene" not in click(tab, POINTS["low"], "Gaussians")
    tab.work.change(lambda picks: picks.another())
    assert "This is more than half of the scene (" in click(tab, POINTS["floor"], "Gaussians")


def test_a_cut_of_next_to_nothing_is_said(opened):
    tab, _ = opened()
    tab.work.picks = Picks((Picked("low", members=torch.arange(len(OWNER)) == 7),))
    assert "low: 1 Gaussians. This is little more than the points themselves" in tab.work._summary()


def test_only_what_is_picked_is_shown_and_exported(opened):
    tab, config = opened()
    assert "click on it first" in press(tab, tab.files.start, "Not exported")
    click(tab, POINTS["high"], "Gaussians")
    tab.work.show_alone(True)
    wait_until(lambda: len(tab.viewing.visible().surfels) < len(OWNER))
    assert torch.equal(tab.viewing.visible().index, tab.work.picks.chosen.members.nonzero()[:, 0])
    press(tab, tab.files.start, "Exported to")
    surfels, _ = read_ply(config.parent / "exports/picked_object_1.ply")
    exact = solids(COLOURED)[0].means[tab.work.picks.chosen.members]
    torch.testing.assert_close(surfels.means, exact)
    click(tab, POINTS["low"], "shows nothing")  # it is not drawn


def test_a_box_limits_the_object_and_excludes(opened):
    tab, _ = opened()
    x, y = position(POINTS["high"])

    def drag(half: float, exclude: bool, text: str) -> str:
        tab.excludes.value, tab.note = exclude, ""
        tab.take_box(True)
        corners = ((x + half, y + half), (x - half, y - half))
        tab.boxed(SimpleNamespace(screen_pos=corners, client=SimpleNamespace(camera=page())))
        return told(tab, text)

    assert "Nothing has been changed" in drag(0.001, False, "was no box")
    drag(0.06, False, "Gaussians")
    small = tab.work.picks.chosen.members
    assert small.any() and overlap(small, (OWNER == 2) & small) == 1 and small.sum() < (OWNER == 2).sum() / 2
    press(tab, tab.work.undo, "nothing yet")
    drag(0.06, True, "No point lies on")
    click(tab, POINTS["low"], "Gaussians")
    click(tab, (0.3, 0.2, 0.5), "Gaussians")
    before = tab.work.picks.chosen.members
    drag(0.06, True, "Gaussians")
    after = tab.work.picks.chosen.members
    assert not (small & after).any() and (before & after).sum() > 0.3 * before.sum()
    assert tab.server.scene._scene_pointer_cb is None  # the page turns again


def heard_by(panel, tab) -> None:
    """Wait until clicks go to this tab alone, or (None) to nobody."""
    wanted = [] if tab is None else [tab.clicked]
    wait_until(lambda: ([] if (box := panel.clicks._around) is None else box._impl.click_cb) == wanted)


def test_the_box_around_the_scene_is_seen_from_inside_and_taken_away(opened):
    from beags_plugin.plugin.viewer.clicks import _INSIDES

    tab, _ = opened()
    panel = tab.viewing.model.viewer_panel
    for _ in range(2):
        tab.clicks.value = True
        heard_by(panel, tab)
    panel.size_tab.clicks.value = True
    heard_by(panel, panel.size_tab)
    assert not tab.clicks.value
    panel.size_tab.clicks.value = False
    heard_by(panel, None)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    for a, b, c in corners[np.array(_INSIDES)]:
        assert np.cross(b - a, c - a) @ a < 0


def test_masks_are_saved_for_training_views_and_never_over_others(opened, capsys):
    tab, config = opened()
    lab, picked = config.parent.parent / "lab", config.parent / "picked"
    assert f"writes to {picked}" in tab._where.content and tab.folder.value == str(picked)
    assert "nothing has been picked" in press(tab, tab.work.save_masks, "Nothing has been changed").lower()
    click(tab, POINTS["low"], "Gaussians")
    tab.work.change(lambda picks: picks.named("low").another())
    click(tab, POINTS["high"], "Gaussians")
    tab.work.change(lambda picks: picks.named("low"))
    assert "two objects called 'low'" in press(tab, tab.work.save_masks, "Nothing has been changed")
    assert not picked.exists()
    tab.work.change(lambda picks: picks.named("high"))
    assert str(picked / "masks") in press(tab, tab.work.save_masks, "Saved")
    assert not (lab / "masks").exists(), "the photos' folder may be somebody else's"
    assert tab.command in capsys.readouterr().out.splitlines() and pasteable(tab.command) in tab._where.content
    refine, at = parsed_command(tab.command)
    assert refine["data"] == lab and refine["load_dir"] == config.parent / "nerfstudio_models"
    assert (at.masks_path, at.classes_path) == (picked / "masks", picked / "classes.json")
    assert at.orientation_method == "none"  # The run has it too.
    assert json.loads((picked / "classes.json").read_text()) == {"0": "background", "1": "low", "2": "high"}
    files = sorted((picked / "masks").glob("*.png"))
    cameras = {f"v{index}": camera for index, camera in enumerate(views()[3:] + views()[:3])}
    assert 0 < len(files) < len(cameras), "held-out views have none"
    inputs = geometry_inputs(solids(COLOURED)[0], OWNER.int())
    for file in files:
        light = make_rasterizer("auto").class_channels(inputs, cameras[file.stem], SETTINGS, 3)
        exact = torch.where(light.amax(dim=-1) > 0.5, light.argmax(dim=-1), 0).numpy()
        found = read_id_mask(file)
        for number in (1, 2):
            if (exact == number).sum() > 50:
                assert ((found == number) & (exact == number)).sum() > 0.9 * (
                    (found == number) | (exact == number)
                ).sum()
    click(tab, (0.3, 0.2, 0.5), "Gaussians")
    assert str(picked / "masks") in press(tab, tab.work.save_masks, "Replaced")
    files[0].write_bytes(files[1].read_bytes())  # mended by hand
    mended = files[0].read_bytes()
    press(tab, lambda: tab.work.save_masks(picked), "name another folder")
    assert str(config.parent / "picked_2/masks") in press(tab, tab.work.save_masks, "Saved")
    assert files[0].read_bytes() == mended
    assert len(list((config.parent / "picked_2/masks").glob("*.png"))) == len(files)
    press(tab, lambda: tab.work.save_masks(lab), "Saved")  # asked for
    assert len(list((lab / "masks").glob("*.png"))) == len(files) and "--masks-path" not in tab.command


def test_a_name_that_is_being_typed_is_kept(opened):
    tab, _ = opened()
    tab.name.value = "cup"  # has come from the page, but its handler has not run
    click(tab, POINTS["low"], "Gaussians")
    assert tab.name.value == "cup"
    tab._rename(tab.name.value)
    tab.work.change(lambda picks: picks.another())
    click(tab, POINTS["high"], "Gaussians")
    assert [one.name for one in tab.work.picks.objects] == ["cup", "object 1"]
    assert tab.name.value == "object 1"
    tab._choose("cup")
    click(tab, POINTS["low"], "Gaussians")
    assert tab.picked.value == tab.name.value == "cup"


def test_masks_are_saved_for_photos_that_were_named_when_the_viewer_was_opened(opened, tmp_path):
    """``beags view RUN --data X`` names them where the photos that the run was trained on are gone."""
    tab, config = opened()
    moved = tmp_path / "photos elsewhere"
    (config.parent.parent / "lab").rename(moved)
    tab.viewing.run.datamanager.config.data = moved
    click(tab, POINTS["low"], "Gaussians")
    press(tab, tab.work.save_masks, "Saved")
    assert parsed_command(tab.command)[0]["data"] == moved


def parsed_command(command: str):
    """Return --data and --load-dir of a command of ns-train, and the options of beags-data, as ns-train parses them."""
    program, preset, *words = shlex.split(command)
    assert (program, preset) == ("ns-train", "beags-refine")
    options, own = words[: words.index("beags-data")], words[words.index("beags-data") + 1 :]
    flags = dict(zip(options[::2], options[1::2], strict=True))
    kind = tyro.conf.FlagConversionOff[BeagsDataParserConfig]
    return {flag[2:].replace("-", "_"): Path(value) for flag, value in flags.items()}, tyro.cli(kind, args=own)


def test_the_command_has_the_runs_options_of_its_data():
    parser = BeagsDataParserConfig(
        data=Path("/x y"), downscale_factor=2.0, ignore_ids=(3, 255), images_path=Path("a 'b'"), strict=True
    )
    head, *words = option_words(parser)
    assert head == "beags-data" and option_words(BeagsDataParserConfig(data=Path("z"))) == []
    found = tyro.cli(tyro.conf.FlagConversionOff[BeagsDataParserConfig], args=words)
    assert replace(found, data=parser.data) == parser
    assert option_words(replace(parser, auto_scale_poses=False)) == option_words(parser), "ns-train has no such option"


def test_the_other_sides_of_a_cut_are_shown_before_it_is_saved(opened):
    """The sides from which nobody has clicked show the cut in its colour."""
    tab, _ = opened()
    assert tab._sides.content == ""
    click(tab, POINTS["low"], "Gaussians")
    wait_until(lambda: tab._sides.content)
    coded = re.search(r"base64,([^\"]+)", tab._sides.content)
    picture = np.asarray(Image.open(BytesIO(base64.b64decode(coded[1])))).astype(int)
    assert picture.shape == (304, 304, 3)
    red, green, blue = colorize(np.array([[FIRST_COLOR]]))[0, 0].astype(int) - 128
    tinted = ((picture - 128) * [red, green, blue]).sum(axis=2)
    for top in (0, 154):
        for left in (0, 154):
            assert (tinted[top : top + 150, left : left + 150] > 0.3 * (red**2 + green**2 + blue**2)).mean() > 0.02
    press(tab, tab.work.undo, "nothing yet")
    wait_until(lambda: not tab._sides.content)


def test_sides_are_far_from_the_clicks_and_from_one_another():
    cameras = ring_cameras(12, 1)
    towards = torch.stack([camera.center / camera.center.norm() for camera in cameras])
    found = other_sides(cameras, torch.zeros(3, dtype=torch.float64), [cameras[0].center])
    assert len(found) == 4 and found[0] == int((towards @ towards[0]).argmin())
    shown = towards[[0, *found]]
    assert float((shown @ shown.T - 2 * torch.eye(5)).max()) < 0.9  # no two of them are neighbours
    assert other_sides(cameras, 100.0 * torch.ones(3, dtype=torch.float64), []) == []


@pytest.mark.slow("cuts, writes and opens a run several times")
def test_what_is_kept_is_the_runs_for_every_command(opened):
    tab, config = opened()
    run = config.parent
    click(tab, POINTS["low"], "Gaussians")
    tab.work.change(lambda picks: picks.named("low"))
    low = tab.work.picks.chosen.members
    press(tab, tab.work.keep, "Kept in")
    assert tab.work.picks.changed() == [] and "low (of the run)" in _options(tab, "low (of the run)")
    press(tab, tab.work.undo, "nothing to undo")
    press(tab, tab.work.save_masks, "Saved")
    scene = read_run(config)
    assert scene.picked and scene.assigned and torch.equal(scene.members.of(1), low) and scene.classes[1] == "low"
    (extracted,) = extract_objects(config, ["low"])
    (exported,) = export_run(config, ["low"], keep_all=True)
    assert 0 < extracted.gaussians <= exported.gaussians == int(low.sum())

    again, _ = opened(config=config)
    model = again.viewing.model
    assert bool(model.assigned) and torch.equal(model.members().of(1), low) and model.classes[1] == "low"
    checkpoint = next((run / "nerfstudio_models").glob("*.ckpt"))
    content = torch.load(checkpoint, weights_only=False)
    content["pipeline"]["_model.gauss_params.means"] += 0.1
    torch.save(content, checkpoint)
    trained_on = read_run(config)
    assert not trained_on.assigned and not trained_on.picked, "another training has other Gaussians"
    (run / PICKED_FILE).write_bytes(b"no file of torch")
    with pytest.raises(UserError, match=r"picked\.pt, what was picked in the viewer, is damaged"):
        read_run(config)
    broken, _ = opened(config=config)
    assert "damaged" in broken.viewing.model.viewer_panel.notes["picked"]


def _options(tab, wanted: str) -> tuple[str, ...]:
    wait_until(lambda: wanted in tab.picked.options, lambda: tab.picked.options)
    return tab.picked.options


def _correct(tab, label: str, class_id: int) -> None:
    """Choose an object of the run, and wait until clicks are about it."""
    _options(tab, label)
    tab._choose(label)
    wait_until(lambda: tab.work.picks.chosen.class_id == class_id)


def test_an_object_of_the_run_is_corrected_and_the_run_remembers(opened):
    """The low block has floor about it: a click takes that away."""
    tab, config = opened(assigned=True)
    before = read_run(config).members
    assert overlap(before.of(1), OWNER == 1) < 0.9
    _correct(tab, "low (of the run)", 1)
    click(tab, (-0.7, 0.3, 0.0), "Gaussians", exclude=True)
    press(tab, tab.work.keep, "Kept in")
    after = read_run(config)
    assert overlap(after.members.of(1), OWNER == 1) > 0.95 and after.classes == {0: "background", 1: "low", 2: "high"}
    assert torch.equal(after.members.of(2), before.of(2))
    assert torch.equal(tab.viewing.model.members().class_ids, after.members.class_ids)


@pytest.mark.slow("cuts, writes and opens a run several times")
def test_an_extracted_run_is_corrected_and_drawn_and_the_run_that_it_is_from_stays(opened, tmp_path):
    """The object has floor about it, which a point beside it takes away."""
    config, _ = write_solids_run(tmp_path / "run", write_solids(tmp_path / "lab"), assigned=True)
    (extracted,) = extract_objects(config, ["low"], keep_all=True)
    tab, _ = opened(config=extracted.config)
    before = read_run(config).members
    owner = OWNER[before.of(1)]
    _correct(tab, "low (of the run)", 1)
    click(tab, (-0.7, 0.3, 0.0), "Gaussians", exclude=True)
    block = tab.work.picks.chosen.members
    assert len(block) == len(owner) and overlap(block, owner == 1) > 0.95 > (owner == 1).double().mean()
    press(tab, tab.work.keep, "Kept in")
    assert torch.equal(read_run(extracted.config).members.of(1), block)
    assert torch.equal(read_run(config).members.class_ids, before.class_ids)
    (again,) = extract_objects(extracted.config, ["low"], output=tmp_path / "out", keep_all=True)
    assert again.gaussians == int(block.sum())
    press(tab, tab.work.save_masks, "Saved")
    assert any((read_id_mask(file) == 1).any() for file in (extracted.config.parent / "picked/masks").glob("*.png"))


def test_objects_of_another_programs_scene_are_picked(opened, tmp_path):
    """A .ply of 3D Gaussians in no order of ours, of which ``beags-base`` made a run."""
    from beags_plugin.plugin.launch import train
    from beags_plugin.plugin.presets import preset_config

    lab, ply, run = write_solids(tmp_path / "lab"), tmp_path / "scene.ply", tmp_path / "run"
    surfels, order = solids(COLOURED)[0], torch.randperm(len(OWNER), generator=torch.Generator().manual_seed(0))
    write_ply(ply, surfels[order], layout="3dgs")
    options = {"vis": "tensorboard", "pipeline.model.base_steps": 1, "pipeline.model.start_from": ply}
    config = preset_config("beags-base", options, run)
    config.data_config.data, config.run_dir = lab, run
    train(config)
    tab, _ = opened(config=run / "config.yml")
    scene = read_run(run / "config.yml")
    assert not scene.assigned and len(scene.surfels()) == len(order)
    transform, scale = read_transform(run)
    moved = not torch.allclose(transform, torch.eye(4, dtype=torch.float64)[:3])
    assert scale != 1.0 or moved, "the run has a frame of its own"
    view = replace(VIEW, viewmat=in_run(VIEW.viewmat, transform, scale))
    for name, number in (("low", 1), ("high", 2)):
        tab.note = ""
        tab.clicked(SimpleNamespace(screen_pos=position(POINTS[name]), client=SimpleNamespace(camera=page(view))))
        told(tab, "Gaussians")
        assert overlap(tab.work.picks.chosen.members, OWNER[order] == number) > 0.95
        tab.work.change(lambda picks, name=name: picks.named(name).another())
    press(tab, tab.work.keep, "Kept in")
    assert sorted(read_run(run / "config.yml").classes.values()) == ["background", "high", "low"]
    (exported,) = export_run(run / "config.yml", ["low"], keep_all=True)
    (file,) = exported.files
    assert file.path is not None
    found, _ = read_ply(file.path)
    nearest = torch.cdist(found.means.double(), surfels.means.double()).min(dim=1)
    assert float(nearest.values.max()) < 0.02, "in the frame of the file"
    assert overlap(torch.isin(torch.arange(len(OWNER)), nearest.indices), OWNER == 1) > 0.95


def in_run(viewmat: torch.Tensor, transform: torch.Tensor, scale: float) -> torch.Tensor:
    """Return a view of the input frame as one of the run's, for which x' = scale (R x + t)."""
    turn, shift = transform[:, :3].double(), transform[:, 3].double()
    moved = viewmat.double().clone()
    moved[:3, :3] = viewmat[:3, :3].double() @ turn.T
    moved[:3, 3] = scale * (viewmat[:3, 3].double() - moved[:3, :3] @ shift)
    return moved.float()


def test_a_training_has_no_tab(tmp_path):
    config, _ = write_solids_run(tmp_path / "run", write_solids(tmp_path / "lab"))
    trainer = SimpleNamespace(training_state="training")
    window = Window(config, trainer)
    try:
        assert window.panel.pick_tab is None
    finally:
        window.close()
