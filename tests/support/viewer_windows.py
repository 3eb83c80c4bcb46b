"""Nerfstudio's viewer of a run, or what stands for it, without a browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.utils.writer import GLOBAL_BUFFER, EventName
from nerfstudio.viewer.render_state_machine import RenderStateMachine
from nerfstudio.viewer.utils import CameraState
from nerfstudio.viewer.viewer import Viewer
from run_folders import write_prepared, write_scene, write_trained
from viser import _gui_api, _gui_handles, _icons

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.plugin.viewer.serve import viewed_pipeline

_gui_api.svg_from_icon = _gui_handles.svg_from_icon = cache(_icons.svg_from_icon)
"""Viser lists an archive of thousands of icons for each one that it shows."""

ALWAYS = {"rgb", "depth", "normal", "accumulation"}


def wait_until(condition: Callable[[], object], said: Callable[[], object] = str, seconds: float = 120.0) -> None:
    """Wait until a condition holds; said: returns what a failure shows."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, said()
        time.sleep(0.02)


def told(tab, text: str) -> str:
    """Return the sentence of the tab Pick, once it holds ``text``."""
    wait_until(lambda: text in tab.note, lambda: tab.note)
    return tab.note


def write_finished(root: Path) -> Path:
    """Write a run that was prepared; return its config.yml."""
    config = write_trained(root / "run", write_scene(root / "lab"))
    write_prepared(root / "run", shift=1)
    return config


class Window:
    """Nerfstudio's viewer of a run, with a client that keeps the pictures it is sent."""

    def __init__(self, config_path, trainer=None, change=lambda model: None) -> None:
        config, pipeline, _, _ = eval_setup(config_path, test_mode="test")
        change(pipeline.model)
        pipeline.model.viewer_panel._begin_to_follow = lambda viewer: None  # the tests call follow() when they want it
        config.viewer.websocket_port = None
        self.lock = threading.Lock()
        log = config.get_base_dir() / "viewer.log"
        # viser would look through all processes for yarn, and fail if one ends meanwhile
        with mock.patch("viser._client_autobuild._check_viser_yarn_running", return_value=False):
            self.viewer = Viewer(config.viewer, log, pipeline.datamanager.get_datapath(), pipeline, trainer, self.lock)
        self.model = pipeline.model
        self.panel = pipeline.model.viewer_panel
        self.sent: list[np.ndarray] = []
        scene = SimpleNamespace(set_background_image=lambda image, **_: self.sent.append(image))
        self.client = SimpleNamespace(scene=scene, camera=SimpleNamespace(aspect=1.5))

    def close(self) -> None:
        self.viewer.viser_server.stop()

    def look(self, output: str = "rgb") -> dict[str, torch.Tensor]:
        """Render and send as the render thread does; return the outputs of the model. An error there is raised here."""
        self.viewer.control_panel._output_render.set_options([output])
        # the drop-down keeps the one option
        return self._drawn(lambda machine, outputs: setattr(machine, "output_keys", set(outputs)))

    def look_as_it_opens(self) -> dict[str, torch.Tensor]:
        """Look in full size, with the outputs that nerfstudio chooses itself."""
        return self._drawn(lambda machine, outputs: None, "high")

    def _drawn(self, before_sending: Callable, state: str = "low_static") -> dict[str, torch.Tensor]:
        # The speed that an earlier training in this process has measured would decide the picture's size.
        GLOBAL_BUFFER.get("events", {}).pop(EventName.VIS_RAYS_PER_SEC.value, None)
        machine = RenderStateMachine(self.viewer, 10.0, self.client)
        machine.state = state
        found: list = []

        def draw() -> None:
            try:
                outputs = machine._render_img(CameraState(0.9, 1.5, camera_to_world(), CameraType.PERSPECTIVE))
                before_sending(machine, outputs)
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
    """The same without server and pictures: what the panel is told of a viewer, quick to make.

    data: as of ``beags view --data``.
    """

    def __init__(self, config_path, trainer=None, change=lambda model: None, data: Path | None = None) -> None:
        opened = eval_setup(config_path, test_mode="test") if data is None else viewed_pipeline(config_path, data)
        pipeline = opened[1]
        self.model, self.panel = pipeline.model, pipeline.model.viewer_panel
        change(self.model)
        self.panel._follow = lambda: None
        self.controls = SimpleNamespace(
            output_render="rgb", split=False, crop_viewport=False, update_output_options=lambda names: None
        )  # fmt: skip
        viewer = SimpleNamespace(
            log_filename=config_path.parent / "viewer.log", pipeline=pipeline, trainer=trainer, train_lock=None,
            control_panel=self.controls, _trigger_rerender=lambda: None, viewer_elements=[("elsewhere", None)],
            viser_server=SimpleNamespace(on_client_connect=lambda joined: None),
        )  # fmt: skip
        self.panel.refresh_objects()
        self.panel.attach(viewer, SimpleNamespace(register_pointer_cb=lambda *_: None))

    def look(self, output: str = "rgb") -> dict[str, torch.Tensor]:
        """Return what the viewer's render thread would get."""
        self.controls.output_render = output
        K = torch.tensor([[60.0, 0, 45], [0, 60, 30], [0, 0, 1]])
        with torch.no_grad():
            return self.model.eval().viewing.outputs(Camera(viewmat_from_opengl(camera_to_world()), K, 90, 60))


def camera_to_world() -> torch.Tensor:
    """Return the pose at 3 along x that looks towards the origin, OpenGL axes, z up."""
    return torch.tensor([[0.0, 0, 1, 3], [1, 0, 0, 0], [0, 1, 0, 0.2]])
