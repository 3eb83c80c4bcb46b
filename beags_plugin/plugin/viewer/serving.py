"""Change nerfstudio's viewer while it serves one of our runs; other methods' viewers stay as they are."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.render_state_machine import RenderStateMachine

from beags_plugin.plugin.viewer.pace import Pace

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer
    from viser import GuiApi, GuiTabHandle, ViserServer

    from beags_plugin.plugin.viewer.window import Windows


@contextmanager
def first_folder(gui: GuiApi, label: str) -> Iterator[Any]:
    """Put controls into a folder above all others of the tab; yield nerfstudio's own folder for us, which stays empty.

    That folder, Custom Elements > model, is the last of the tab.
    """
    inner = gui._get_container_id()
    folders: Any = gui._container_handle_from_id
    outer = folders[folders[inner]._parent_container_id]
    gui._set_container_id(outer._parent_container_id)
    with gui.add_folder(label, order=-1.0):
        yield outer
    gui._set_container_id(inner)


def another_tab(gui: GuiApi, label: str, first: bool = False) -> GuiTabHandle:
    """Add a tab beside those of nerfstudio's panel; return it, for ``with``. first: pages open with it."""
    from viser import GuiTabHandle

    folders: Any = gui._container_handle_from_id
    tab = next(handle for handle in folders.values() if isinstance(handle, GuiTabHandle))
    group = tab._parent
    added = group.add_tab(label)
    if first:
        lists: list[list[Any]] = [group._labels, group._icons_html, group._tabs]
        for listed in lists:
            listed.insert(0, listed.pop())
        group._sync_with_client()
    return added


def by_user(listener: Callable[[], None]) -> Callable[[Any], None]:
    """Return a listener that ignores values which the program itself has written to a control."""

    def called(event: Any) -> None:
        if event.client_id is not None:
            listener()

    return called


def show_text(handle: Any, text: str) -> None:
    """Show a text in a Markdown element, unless it does already or the viewer is closing."""
    with suppress(KeyError):  # The element is gone.
        if handle.content != text:
            handle.content = text


def set_pace(viewer: Viewer, client_id: int, pace: Pace, windows: Windows | None) -> None:
    """Let ``pace`` choose the size of a page's pictures while its camera moves, and ``windows`` the size at rest.

    windows: no picture is larger than its size at rest; if None, nerfstudio chooses the size at rest.
    """
    machine, controls = viewer.render_statemachines[client_id], viewer.control_panel
    still = machine._calculate_image_res

    def size(aspect_ratio: float) -> tuple[int, int]:
        rest = None if windows is None else windows.size(client_id, aspect_ratio)
        if machine.state != "high":
            return pace.size(aspect_ratio, controls.max_res if rest is None else max(rest))
        return rest or still(aspect_ratio)

    machine._calculate_image_res = size  # type: ignore[method-assign]


def hide_training_cameras(viewer: Viewer, hit: Callable[[int], None]) -> None:
    """Hide the training cameras at first: they stand before the objects, and intercept clicks.

    hit: is called with the index of a training view whose camera was clicked.
    """
    draw = viewer.init_scene

    def draw_hidden(*arguments: Any, **options: Any) -> None:
        draw(*arguments, **options)
        viewer.set_camera_visibility(False)
        viewer.toggle_cameravis_button()
        for index, handle in viewer.camera_handles.items():
            handle.on_click(lambda _, index=index: hit(index))

    viewer.init_scene = draw_hidden  # type: ignore[method-assign]


def offer_whole_pictures(controls: Any) -> None:
    """Remove nerfstudio's "gl_z_buf_depth" from the lists of outputs.

    It is smaller than the picture, and it is the first choice for the split screen, where joining the two would end the
    render thread.
    """
    offer = controls.update_output_options
    controls.update_output_options = lambda names: offer([name for name in names if name != "gl_z_buf_depth"])


class Follower(threading.Thread):
    """Does a step every ``seconds`` while ``running``. viewer: nerfstudio's. failed: receives exceptions, as text."""

    def __init__(self, viewer: Viewer, step: Callable[[], None], seconds: float, failed: Callable[[str], None]) -> None:
        super().__init__(name="beags panel", daemon=True)
        self.viewer = viewer
        self.running = True
        self._step, self._seconds, self._failed = step, seconds, failed

    def run(self) -> None:
        """Do the steps."""
        while self.running:
            time.sleep(self._seconds)
            try:
                self._step()
            except Exception as error:
                self._failed(f"{type(error).__name__}: {error}")


def end_threads(viewer: object) -> None:
    """End the render threads of every page of a viewer and what follows them, waiting at most 30 s for each to finish.

    viewer: nerfstudio's, or None. A thread inside the rasterizer or torch would abort an interpreter that ends.
    """
    threads = [
        thread
        for thread in threading.enumerate()  # It knows threads of closed pages too.
        if isinstance(thread, (RenderStateMachine, Follower)) and thread.viewer is viewer
    ]
    for thread in threads:
        thread.running = False
    for thread in threads:
        thread.join(30.0)


def end_when_interrupted(server: ViserServer) -> None:
    """Let Ctrl-C, which is the only way to end ns-viewer, end it without a traceback and with exit code 0."""
    former = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, traceback: Any) -> None:
        if not issubclass(kind, KeyboardInterrupt):
            return former(kind, error, traceback)
        server.stop()  # It prints a message.
        sys.stderr.flush()
        print("\nThe viewer is closed.", flush=True)
        os._exit(0)  # A normal exit would abort in a render thread inside the rasterizer.

    sys.excepthook = hook
