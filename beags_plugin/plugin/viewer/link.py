"""What passes nerfstudio's viewer to our panel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nerfstudio.viewer.viewer_elements import ViewerControl

from beags_plugin.plugin.viewer.panel import ObjectPanel

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer


class ViewerLink(ViewerControl):
    """Passes nerfstudio's viewer, once there is one, and clicks on the picture to the panel."""

    viewer: Viewer | None = None

    def __init__(self, panel: ObjectPanel) -> None:
        self.panel = panel

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        self.panel.attach(viewer, self)
