"""The panel and the pictures in nerfstudio's own viewer, with its render thread, but without a browser."""

from __future__ import annotations

import re
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from run_folders import CLASSES

pytest.importorskip("nerfstudio")

from nerfstudio.viewer.viewer_elements import ViewerClick
from viewer_windows import ALWAYS, Window, wait_until, write_finished
from written_splats import read_ply

from beags_plugin.core.membership import Membership
from beags_plugin.labels.colors import colorize
from beags_plugin.plugin.viewer.choice import Choice
from beags_plugin.plugin.viewer.serving import Follower, end_threads
from beags_plugin.plugin.viewer.viewed_run import ViewedRun
from beags_plugin.plugin.viewer.viewing import CHANNELS


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return write_finished(tmp_path_factory.mktemp("viewer"))


@pytest.fixture(scope="module")
def opened(finished):
    window = Window(finished)
    yield window
    window.close()


@pytest.fixture
def window(opened):
    """Return the viewer of the finished run, as it is when it opens."""
    opened.model.viewing.run = ViewedRun(opened.model.viewing.run.folder, opened.model.viewing.run.datamanager)
    opened.model.viewing.notes, opened.panel.notes = {}, {}
    opened.panel.choose(Choice())
    yield opened


def test_every_output_is_a_picture_whatever_is_shown(window):
    """Nerfstudio's render thread dies of any exception: none may come of any output with any choice."""
    panel, model = window.panel, window.model
    assert set(window.look()) == ALWAYS | set(CHANNELS) | {"gl_z_buf_depth"}
    choices = [Choice(), Choice().isolate(1), Choice(faded_opacity=0.3).hide(2), Choice().remove(0).remove(1).remove(2)]
    for choice in choices:
        panel.choose(choice)
        for name in (*ALWAYS, *CHANNELS):
            outputs = window.look(name)
            shape = outputs["rgb"].shape
            for key, value in outputs.items():
                if key != "gl_z_buf_depth":
                    assert value.dtype == torch.float32 and value.shape[:2] == shape[:2] and value.shape[2] in (1, 3)
                    assert bool(value.isfinite().all())
            assert window.sent[-1].shape == (*shape[:2], 3)
    assert float(window.look()["accumulation"].sum()) == 0.0  # the last choice leaves nothing
    panel.choose(Choice())
    controls = window.viewer.control_panel
    controls._crop_center.value, controls._crop_scale.value = (9.0, 9.0, 9.0), (0.1, 0.1, 0.1)
    controls.crop_viewport = True
    assert len(model.viewing.copy().surfels) == 0 and float(window.look()["accumulation"].sum()) == 0.0
    controls.crop_viewport = False
    assert len(model.viewing.copy().surfels) == model.num_points


def test_the_split_screen_shows_two_outputs_as_soon_as_it_is_opened(window):
    """Nerfstudio would put its small depth into it, which does not fit."""
    controls = window.viewer.control_panel
    size = controls._max_res.value
    controls._split.value, controls._max_res.value = True, 1024
    try:
        drawn = window.look_as_it_opens()
        height, width = drawn["rgb"].shape[:2]
        assert drawn["gl_z_buf_depth"].shape[:2] != (height, width) and window.sent[-1].shape == (height, width, 3)
        assert controls.split_output_render in (*ALWAYS, *CHANNELS)
        assert "gl_z_buf_depth" not in (*controls._output_render.options, *controls._split_output_render.options)
    finally:
        controls._split.value, controls._max_res.value = False, size


@pytest.mark.parametrize("class_id", [0, 1, 2])
def test_objects_that_overlap_are_drawn_as_each_would_be_alone(window, class_id):
    """Isolated, hidden and removed; the cup has Gaussians of the box, and some of its own belong to nobody."""
    panel, model = window.panel, window.model
    plain, phi = model.members(), model.class_ids.clone()
    masks = {1: (phi == 1) | (phi == 2) & (torch.arange(len(phi)) % 3 == 0), 2: phi == 2}
    masks[1][(phi == 1).nonzero()[::4]] = False
    members = Membership.of_masks(masks, phi)
    shared = masks[1] & masks[2]
    assert bool(shared.any()) and not bool((members.of(0) == (phi == 0)).all())
    # one object against all else, which is told by another class
    alone = Membership(torch.where(members.of(class_id), class_id, 1 if class_id != 1 else 0).int())
    choices = [Choice().isolate(class_id), Choice().hide(class_id), Choice(faded_opacity=0.5).remove(class_id)]
    try:
        for choice in choices:
            looks = []
            for each in (members, alone):
                model.take_members(each)
                panel.choose(choice)
                looks.append({**window.look("class_map"), **window.look("class_confidence")})
                index = model.viewing.copy().index
                expected = members.of(class_id) if choice is choices[0] else ~members.of(class_id)
                assert torch.equal(index, expected.nonzero()[:, 0])
            overlapping, exclusive = looks
            for name in ALWAYS:
                assert torch.equal(overlapping[name], exclusive[name]), (choice, name)
            if choice is choices[0]:  # shared Gaussians are in the object's colour
                assert torch.equal(overlapping["class_map"], exclusive["class_map"])
                assert torch.equal(overlapping["class_confidence"], exclusive["class_confidence"])
        model.take_members(members)
        panel.follow()
        assert panel.listed.counts == {c: int(members.of(c).sum()) for c in (0, 1, 2)}
        assert sum(panel.listed.counts.values()) == len(phi) + int(shared.sum())
    finally:
        model.take_members(plain)


def test_what_is_hidden_in_the_viewer_changes_no_figure(window):
    """Evaluation draws the whole scene on the run's background, also while a viewer shows something else."""
    model = window.model
    camera = window.viewer.pipeline.datamanager.eval_dataset.cameras[:1]
    before = model.get_outputs_for_camera(camera)
    window.panel.choose(Choice(min_opacity=0.5).isolate(1))
    alone = window.look()
    assert float(model.viewing.background.sum()) > 0  # the viewer's own
    after = model.get_outputs_for_camera(camera)
    assert set(before) == ALWAYS | {"background", "class_map", "class_confidence"}
    assert all(torch.equal(before[name], after[name]) for name in before)
    window.panel.choose(Choice())
    assert 0 < float(alone["accumulation"].sum()) < 0.7 * float(window.look()["accumulation"].sum())


def test_masks_and_boundary_are_those_of_the_nearest_training_view(window):
    """The camera is about that of view 0, which is held out: the pictures are of the next one, and say so."""
    before, after = (window.look(name)[name] for name in ("mask_before", "mask_after"))
    assert window.model.viewing.notes["view"] == "mask_after: of training view v01, the nearest."
    colors = {tuple(color) for color in (255 * after).round().byte().reshape(-1, 3).tolist()}
    assert colors == {tuple(color) for color in colorize(np.array([[0, 1, 2]]))[0].tolist()}
    assert not torch.equal(before, after)
    ids = [window.model.viewing.run.mask(0, kind, 20, 12) for kind in ("before", "after")]
    assert torch.equal(ids[0].roll(1, 0), ids[1]) and set(ids[0].unique().tolist()) == {0, 1, 2}
    error = window.look("boundary_error")["boundary_error"]
    assert 0.0 < float(error.max()) <= 1.0
    window.panel.choose(Choice().remove(0).remove(1).remove(2))
    assert float(window.look("boundary_error")["boundary_error"].max()) == 0.0


def test_a_click_picks_the_object_under_the_cursor(window):
    panel, model = window.panel, window.model
    surfels, ids = model.surfels(), model.class_ids
    for class_id in (1, 2):
        panel.choose(Choice().isolate(class_id))
        target = surfels.means[ids == class_id][0].tolist()
        origin = (3.0, 0.0, 0.3)
        panel.clicked(ViewerClick(origin, tuple(t - o for t, o in zip(target, origin, strict=True)), (0.5, 0.5)))
        assert panel.notes["object"].startswith(f"Picked: {CLASSES[class_id]} ")
        assert panel.object.value == CLASSES[class_id]
    panel.clicked(ViewerClick((3.0, 0.0, 0.3), (1.0, 0.0, 0.0), (0.5, 0.5)))
    assert panel.notes["object"] == "Nothing is shown there." and panel.object.value == "box"
    panel.choose(Choice().isolate(0))
    target = surfels.means[ids == 0][0].tolist()
    panel.listen(True)
    panel.clicked(ViewerClick((3.0, 0.0, 0.3), (target[0] - 3.0, target[1], target[2] - 0.3), (0.5, 0.5)))
    assert "background: nothing chosen" in panel.notes["object"] and panel.object.value == "box"
    assert window.viewer.viser_server.scene._scene_pointer_cb is None  # one click only: pages may turn again


def test_buttons_and_sliders_change_what_is_shown(window):
    panel = window.panel
    panel.object.value = "cup"
    panel.act("Isolate")
    assert window.model.viewing.choice == Choice(isolated=1)
    panel.act("Remove")
    panel.object.value = "box"
    panel.act("Hide")
    assert window.model.viewing.choice == Choice(removed=frozenset({1}), hidden=frozenset({2}))
    panel.follow()
    assert "~~cup~~ removed" in panel._legend.content and "~~box~~ |" in panel._legend.content
    panel._slide(faded_opacity=0.4)
    panel._slide(min_opacity=0.1)
    panel.show_all.cb_hook(panel.show_all)
    assert window.model.viewing.choice == Choice(faded_opacity=0.4, min_opacity=0.1)
    for _ in range(2):  # pressed as viser does it: the same button twice
        window.model.viewing.choice = Choice()
        panel.look.gui_handle._impl.value = "Isolate"
        panel.look.cb_hook(panel.look)
        assert window.model.viewing.choice.isolated == 2 and panel.look.value == ""


def test_the_export_holds_what_is_shown_in_full(window, finished):
    panel, ids = window.panel, window.model.class_ids
    panel.choose(Choice(faded_opacity=0.5).isolate(1))
    first, second = panel.files.write(), panel.files.write()
    assert first == finished.parent / "exports/shown_cup.ply" and second.name == "shown_cup_2.ply"
    surfels, classes = read_ply(first)
    assert len(surfels) == int((ids == 1).sum()) and set(classes.tolist()) == {1}
    torch.testing.assert_close(surfels.opacity_logits, window.model.surfels().opacity_logits[ids == 1].detach())
    panel.choose(Choice().remove(1))
    assert panel.files.write().name == "shown_without_cup.ply"
    panel.choose(Choice())
    assert panel.files.write().name == "shown_scene.ply"


def test_an_export_says_in_the_panel_how_it_ended(window, monkeypatch):
    panel = window.panel
    panel.choose(Choice(min_opacity=1.0))
    panel.files.start()
    assert note_of(panel, "Not exported: nothing is shown")
    panel.choose(Choice())
    panel.files.start()
    assert "shown_scene" in note_of(panel, "Exported to")
    panel.follow()
    assert "shown" in panel._status.content
    monkeypatch.setattr(panel.files, "write", lambda scale_by: 1 / 0)
    panel.files.start()
    assert note_of(panel, "Not exported (ZeroDivisionError")
    panel.files.report_views(3, 9)
    assert note_of(panel, "Exporting: 3 of 9 views")
    gate = threading.Event()
    monkeypatch.setattr(panel.files, "write", lambda scale_by: gate.wait())
    panel.files.start()
    panel.files.start()
    assert note_of(panel, "The former export")
    gate.set()


def note_of(panel, beginning: str) -> str:
    wait_until(lambda: panel.notes.get("export", "").startswith(beginning), lambda: panel.notes)
    return panel.notes["export"]


def test_odd_names_and_classes_that_come_later(window):
    """A checkpoint's names reach the drop-down; before classes are assigned there is nothing to choose, no error."""
    panel, model = window.panel, window.model
    classes = model.get_extra_state()
    assert panel.object.options == ["background", "cup", "box"]
    model.set_extra_state({"classes": {0: "background", 1: "{alert(1)}\n<b>", 2: "{alert(1)}\n<b>"}})
    panel.follow()
    assert panel.object.options == ["background", "{alert(1)} <b> (1)", "{alert(1)} <b> (2)"]
    assert panel.object.gui_handle.options == tuple(panel.object.options)
    legend = re.sub(r"<span style=\{\{[^{}]*\}\} />", "", panel._legend.content)  # the squares of colour
    assert "{" not in legend and "<" not in legend
    model.assigned.fill_(False)
    panel.follow()
    assert panel.labels == {} and panel.object.options == ["none yet"]
    panel.act("Isolate")
    assert "no classes yet" in panel.notes["object"] and model.viewing.choice == Choice()
    panel.clicked(ViewerClick((3.0, 0.0, 0.3), (-1.0, 0.0, -0.1), (0.5, 0.5)))
    panel.choose(Choice().isolate(1))  # This choice precedes a change of the scene.
    for name in CHANNELS:
        assert window.look(name)["rgb"].isfinite().all()
    assert "no classes yet" in window.model.viewing.notes.get("classes", "no classes yet")
    assert len(model.viewing.visible().surfels) == model.num_points
    assert panel.files.write().exists()
    model.assigned.fill_(True)
    model.set_extra_state(classes)
    panel.follow()


def test_a_finished_run_shows_no_step_and_where_objects_are_picked(window):
    """nerfstudio would say "Step: 0" of every one."""
    assert "Step" not in window.viewer.stats_markdown.content
    window.look()
    assert re.fullmatch(r"Resolution: \d+x\d+px", window.viewer.stats_markdown.content)
    window.model.assigned.fill_(False)
    window.panel.follow()
    assert "pick objects in the tab Pick" in window.panel._legend.content
    window.model.assigned.fill_(True)
    window.panel.follow()
    assert "tab Pick" not in window.panel._legend.content


def test_panel_and_legend_do_not_wait_for_a_step_but_the_click_does(window, monkeypatch):
    """While a step holds the lock, buttons, legend and notes work; a click gives up after a while."""
    window.panel.follow()
    monkeypatch.setattr(window.model.viewing, "lock", SimpleNamespace(acquire=lambda timeout: False))
    window.panel.act("Hide")
    window.panel.follow()
    window.panel.clicked(ViewerClick((3.0, 0.0, 0.3), (-1.0, 0.0, -0.1), (0.5, 0.5)))
    assert "busy" in window.panel.notes["object"]


def test_what_follows_a_training_ends_before_the_process(window):
    """A thread inside torch aborts a Python that ends."""
    steps = []
    follower = Follower(window.viewer, lambda: steps.append(1), 0.01, steps.append)
    follower.start()
    while not steps:
        time.sleep(0.01)
    end_threads(None)
    assert follower.is_alive()
    end_threads(window.viewer)
    assert not follower.is_alive() and set(steps) == {1}
