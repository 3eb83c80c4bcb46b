"""The panel and the pictures in nerfstudio's own viewer, with its render thread, but without a browser."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from run_folders import CLASSES, write_prepared, write_scene, write_trained

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.cameras import CameraType
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import CameraState
from nerfstudio.viewer.viewer import Viewer
from nerfstudio.viewer.viewer_elements import ViewerClick

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.errors import UserError
from beags_plugin.extraction.ply import read_ply
from beags_plugin.masks.classes import colorize, write_class_map
from beags_plugin.plugin.extract import extract_objects
from beags_plugin.plugin.schedule import PhaseSchedule
from beags_plugin.plugin.viewed_run import ViewedRun
from beags_plugin.plugin.viewing import CHANNELS
from beags_plugin.viewing.choice import Choice

ALWAYS = {"rgb", "depth", "normal", "accumulation"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """config.yml of a run that was prepared."""
    root = tmp_path_factory.mktemp("viewer")
    config = write_trained(root / "run", write_scene(root / "lab"))
    write_prepared(root / "run", shift=1)
    return config


class Window:
    """Nerfstudio's viewer of a run, with a client that keeps the pictures it is sent."""

    def __init__(self, config_path, trainer=None, change=lambda model: None) -> None:
        config, pipeline, _, _ = eval_setup(config_path, test_mode="test")
        change(pipeline.model)
        pipeline.model.viewer_panel._follow = lambda: None  # the tests call follow() when they want it
        config.viewer.websocket_port = None
        self.lock = threading.Lock()
        log = config.get_base_dir() / "viewer.log"
        self.viewer = Viewer(config.viewer, log, pipeline.datamanager.get_datapath(), pipeline, trainer, self.lock)
        self.model = pipeline.model
        self.panel = pipeline.model.viewer_panel
        self.sent: list[np.ndarray] = []
        scene = SimpleNamespace(set_background_image=lambda image, **_: self.sent.append(image))
        self.client = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=1.5))

    def close(self) -> None:
        self.viewer.viser_server.stop()

    def look(self, output: str = "rgb") -> dict[str, torch.Tensor]:
        """Draw and send as the render thread does; the outputs of the model. An error there is raised here."""
        self.viewer.control_panel._output_render.set_options([output])
        machine = RenderStateMachine(self.viewer, 10.0, self.client)
        found: list = []

        def draw() -> None:
            try:
                state = CameraState(0.9, 1.5, camera_to_world(), CameraType.PERSPECTIVE)
                outputs = machine._render_img(state)
                machine.output_keys = set(outputs)  # the drop-down keeps the one option
                machine._send_output_to_viewer(outputs)
                found.append(outputs)
            except BaseException as error:
                found.append(error)

        machine.run = draw
        machine.start()
        machine.join()
        if isinstance(found[0], BaseException):
            raise found[0]
        return found[0]


class Stand:
    """The same without server and pictures: what the panel is told of a viewer, quick to make."""

    def __init__(self, config_path, trainer=None, change=lambda model: None) -> None:
        _, pipeline, _, _ = eval_setup(config_path, test_mode="test")
        self.model, self.panel = pipeline.model, pipeline.model.viewer_panel
        change(self.model)
        self.panel._follow = lambda: None
        self.controls = SimpleNamespace(output_render="rgb", split=False, crop_viewport=False)
        viewer = SimpleNamespace(
            log_filename=config_path.parent / "viewer.log", pipeline=pipeline, trainer=trainer, train_lock=None,
            control_panel=self.controls, _trigger_rerender=lambda: None,
        )  # fmt: skip
        self.panel.refresh_objects()
        self.panel.attach(viewer, SimpleNamespace(register_pointer_cb=lambda *_: None))

    def look(self, output: str = "rgb") -> dict[str, torch.Tensor]:
        """What the viewer's render thread would be given."""
        self.controls.output_render = output
        K = torch.tensor([[60.0, 0, 45], [0, 60, 30], [0, 0, 1]])
        with torch.no_grad():
            return self.model.eval().viewing.outputs(Camera(viewmat_from_opengl(camera_to_world()), K, 90, 60))


def camera_to_world() -> torch.Tensor:
    """From 3 along x towards the origin, OpenGL axes, z up."""
    return torch.tensor([[0.0, 0, 1, 3], [1, 0, 0, 0], [0, 1, 0, 0.2]])


@pytest.fixture(scope="module")
def opened(finished):
    window = Window(finished)
    yield window
    window.close()


@pytest.fixture
def window(opened):
    """The viewer of the finished run, as it is when it opens."""
    opened.model.viewing.run = ViewedRun(opened.model.viewing.run.folder, opened.model.viewing.run.datamanager)
    opened.model.viewing.shares, opened.model.viewing.notes, opened.panel.notes = None, {}, {}
    opened.panel.choose(Choice())
    yield opened


def test_every_output_is_a_picture_whatever_is_shown(window):
    """Nerfstudio's render thread dies of any exception: none may come of any output with any choice."""
    panel, model = window.panel, window.model
    assert set(window.look()) == ALWAYS | set(CHANNELS) | {"gl_z_buf_depth"}
    choices = [Choice(), Choice().isolate(1), Choice(rest=0.3).hide(2), Choice().remove(0).remove(1).remove(2)]
    for choice in choices:
        panel.choose(choice)
        for name in (*ALWAYS, *CHANNELS):
            outputs = window.look(name)
            panel.follow()
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


def test_occupancy_violation_is_drawn_once_the_panel_has_computed_it(window):
    assert float(window.look("occupancy_violation")["occupancy_violation"].sum()) == 0.0
    window.panel.follow()
    violation = window.look("occupancy_violation")["occupancy_violation"]
    assert 0.0 < float(violation.max()) <= 1.0
    shares, ids = window.model.viewing.shares.values, window.model.class_ids
    assert bool((shares[ids == 2] == 1.0).all())  # the box has no voxel
    assert bool((shares[ids == 0] == 0.0).all())  # the grid was made without the background
    assert 0.0 < float(shares[ids == 1].mean()) < 0.9
    assert not window.model.viewing.refresh_shares()  # nothing has changed


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
    panel.clicked(ViewerClick((3.0, 0.0, 0.3), (target[0] - 3.0, target[1], target[2] - 0.3), (0.5, 0.5)))
    assert "background, no object" in panel.notes["object"]


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
    panel._slide(rest=0.4)
    panel._slide(min_opacity=0.1)
    panel.show_all.cb_hook(panel.show_all)
    assert window.model.viewing.choice == Choice(rest=0.4, min_opacity=0.1)
    for _ in range(2):  # pressed as viser does it: the same button twice
        window.model.viewing.choice = Choice()
        panel.look.gui_handle._impl.value = "Isolate"
        panel.look.cb_hook(panel.look)
        assert window.model.viewing.choice.isolated == 2 and panel.look.value == ""


def test_the_export_holds_what_is_shown_in_full(window, finished):
    panel, ids = window.panel, window.model.class_ids
    panel.choose(Choice(rest=0.5).isolate(1))
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
    assert said(panel, "Not exported: nothing is shown")
    panel.choose(Choice())
    panel.files.start()
    assert "shown_scene" in said(panel, "Exported to")
    panel.follow()
    assert "shown" in panel._status.content
    monkeypatch.setattr(panel.files, "write", lambda: 1 / 0)
    panel.files.start()
    assert said(panel, "Not exported (ZeroDivisionError")
    panel.files.say_views(3, 9)
    assert said(panel, "Exporting: 3 of 9 views")
    gate = threading.Event()
    monkeypatch.setattr(panel.files, "write", gate.wait)
    panel.files.start()
    panel.files.start()
    assert said(panel, "The former export")
    gate.set()


def said(panel, beginning: str) -> str:
    end = time.monotonic() + 10
    while not panel.notes.get("export", "").startswith(beginning):
        assert time.monotonic() < end, panel.notes
        time.sleep(0.01)
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
    assert "{" not in panel._legend.content
    model.assigned.fill_(False)
    panel.follow()
    assert panel.labels == {} and panel.object.options == ["none yet"]
    panel.act("Isolate")
    assert "no classes yet" in panel.notes["object"] and model.viewing.choice == Choice()
    panel.clicked(ViewerClick((3.0, 0.0, 0.3), (-1.0, 0.0, -0.1), (0.5, 0.5)))
    panel.choose(Choice().isolate(1))  # as a choice made before a change of the scene
    for name in CHANNELS:
        assert window.look(name)["rgb"].isfinite().all()
    assert "no classes yet" in window.model.viewing.notes.get("classes", "no classes yet")
    assert len(model.viewing.shown().surfels) == model.num_points
    assert panel.files.write().exists()
    model.assigned.fill_(True)
    model.set_extra_state(classes)
    panel.follow()


def test_a_run_in_training_lists_what_will_come(finished):
    trainer = SimpleNamespace(training_state="training")
    window = Stand(finished, trainer, lambda model: model.assigned.fill_(False))
    assert set(window.look()) == ALWAYS | set(CHANNELS)
    assert window.look("class_map")["class_map"].sum() == 0.0
    assert "no classes yet" in window.model.viewing.notes["classes"]
    window.model.assigned.fill_(True)
    window.panel.follow()
    assert window.look("class_map")["class_map"].sum() > 0.0 and window.panel.object.options[1] == "cup"


def test_masks_of_a_former_run_in_the_folder_are_not_shown_while_a_base_is_trained(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    write_prepared(tmp_path / "run", shift=1)
    window = Stand(config, SimpleNamespace(training_state="training"), lambda model: model.assigned.fill_(False))
    run = window.model.viewing.run
    assert run.mask(0, "before", 20, 12) is not None and run.mask(0, "after", 20, 12) is None
    assert not run.has_grid and not run.load_grid()
    window.model.viewing.rounds = lambda: 1  # as the switch to refinement says once it is done
    first = run.mask(0, "after", 20, 12)
    path = tmp_path / "run/prepared/masks" / f"{run.names[0]}.png"
    write_class_map(path, np.zeros((12, 20), np.uint8))  # prepared again
    os.utime(path, ns=(1, path.stat().st_mtime_ns + 1))
    assert set(first.unique().tolist()) == {0, 1, 2} and not run.mask(0, "after", 20, 12).any()
    assert run.has_grid and run.load_grid()


def test_a_base_opened_again_shows_no_masks_of_a_former_run_in_its_folder(tmp_path):
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"), assigned=False)
    write_prepared(tmp_path / "run", shift=1)
    window = Stand(config)
    run = window.model.viewing.run
    assert run.mask(0, "after", 20, 12) is None and not run.has_grid and not run.load_grid()
    assert set(window.look()) == ALWAYS | {"mask_before"}


@pytest.mark.parametrize(("done", "masks"), [(0, 0), (1, 0), (3, 0), (4, 2), (6, 2)])
def test_only_rounds_that_the_scene_has_been_through_are_shown(tmp_path, done, masks):
    """Three rounds of nine steps are prepared before steps 0, 3 and 6; this run has come to step 6, and a former run
    in its folder had another round."""
    config = write_trained(tmp_path / "run", write_scene(tmp_path / "lab"))
    for folder, shift in (("", 0), ("round_2", 2), ("round_3", 3)):
        write_prepared(tmp_path / "run", shift, folder)

    def change(model):
        model.config.refine_rounds, model.schedule = 3, PhaseSchedule(10, 9)
        model.refined_steps.fill_(done)

    run = Stand(config, change=change).model.viewing.run
    before, after = (run.mask(0, kind, 20, 12) for kind in ("before", "after"))
    assert torch.equal(before.roll(masks, 0), after)


def test_panel_and_legend_do_not_wait_for_a_step_but_the_click_does(window, monkeypatch):
    """While a step holds the lock, buttons, legend and notes work; a click gives up after a while."""
    window.panel.follow()
    monkeypatch.setattr(window.model.viewing, "lock", SimpleNamespace(acquire=lambda timeout: False))
    window.panel.act("Hide")
    window.panel.follow()
    window.panel.clicked(ViewerClick((3.0, 0.0, 0.3), (-1.0, 0.0, -0.1), (0.5, 0.5)))
    assert "busy" in window.panel.notes["object"]


def test_an_extracted_run_shows_its_object_and_the_masks_of_the_run_it_is_from(finished, tmp_path):
    (extracted,) = extract_objects(finished, ["cup"], output=tmp_path / "out")
    window = Stand(extracted.config)
    assert window.panel.object.options == ["cup"]
    outputs = window.look("mask_after")
    assert set(outputs) == ALWAYS | set(CHANNELS)
    window.panel.follow()
    assert window.look("mask_after")["mask_after"].sum() > 0
    window.look("occupancy_violation")
    window.panel.follow()
    assert window.look("occupancy_violation")["occupancy_violation"].sum() > 0
    assert window.panel.files.write() == extracted.config.parent / "exports/shown_scene.ply"


@pytest.mark.parametrize("changed", ["a mask", "the grid"])
def test_an_extracted_run_whose_origin_was_trained_again_shows_none_of_its_masks(tmp_path, changed):
    run = tmp_path / "run"
    config = write_trained(run, write_scene(tmp_path / "lab"))
    write_prepared(run, shift=1)
    (extracted,) = extract_objects(config, ["cup"], output=tmp_path / "out")
    (of_extracted,) = extract_objects(extracted.config, ["cup"], output=tmp_path / "twice")
    for each in (extracted, of_extracted):
        assert Stand(each.config).panel.notes == {}
    open_now = Stand(extracted.config).model.viewing.run
    shutil.rmtree(run / "prepared")
    write_prepared(run, shift=1, **({"scale": 2.0} if changed == "the grid" else {}))
    if changed == "a mask":
        write_class_map(run / "prepared/masks/v03.png", np.zeros((12, 20), np.uint8))
    os.utime(run / "prepared/grid.pt", ns=(1, 1))  # another file, even where the clock is coarse
    assert open_now.prepared is None and open_now.mask(0, "after", 20, 12) is None
    for each in (extracted, of_extracted):
        window = Stand(each.config)
        assert set(window.look("rgb")) == ALWAYS | {"class_map", "class_confidence", "boundary_error", "mask_before"}
        assert window.panel.notes["run"] == (
            f"No masks after reprojection and no voxel grid: {run} has been trained again since this was extracted "
            "from it. Extract it again."
        )
    origin = Stand(config)  # the run itself shows what it has
    assert origin.panel.notes == {} and {"mask_after", "occupancy_violation"} <= set(origin.look())
    (again,) = extract_objects(config, ["cup"], output=tmp_path / "out")
    assert Stand(again.config).panel.notes == {}


def test_an_extract_that_does_not_say_what_it_was_prepared_with_shows_what_is_there(finished, tmp_path):
    (extracted,) = extract_objects(finished, ["cup"], output=tmp_path / "out")
    origin = extracted.config.parent / "extraction.json"
    content = json.loads(origin.read_text())
    assert len(content.pop("prepared")) == 1
    origin.write_text(json.dumps(content))
    assert {"mask_after", "occupancy_violation"} <= set(Stand(extracted.config).look())


def test_an_extracted_run_whose_origin_is_gone_lists_less(finished, tmp_path):
    (extracted,) = extract_objects(finished, ["cup"], output=tmp_path / "out")
    origin = extracted.config.parent / "extraction.json"
    origin.write_text(json.dumps({**json.loads(origin.read_text()), "run": str(tmp_path / "gone/config.yml")}))
    window = Stand(extracted.config)
    listed = set(window.look())
    assert listed == ALWAYS | {"class_map", "class_confidence", "boundary_error", "mask_before"}


def test_a_base_without_masks_lists_what_it_has(tmp_path):
    window = Stand(write_trained(tmp_path / "run", write_scene(tmp_path / "lab", masks=False), assigned=False))
    assert set(window.look()) == ALWAYS
    window.panel.follow()
    assert window.panel.object.options == ["none yet"]


def test_without_a_viewer_there_is_no_export(finished):
    _, pipeline, _, _ = eval_setup(finished, test_mode="test")
    with pytest.raises(UserError, match="beags export"):
        pipeline.model.viewer_panel.files.write()
