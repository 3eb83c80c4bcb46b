"""Write what a viewer shows into files, in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from beags_plugin.plugin.viewer.choice import Visible
from beags_plugin.plugin.viewer.viewing import Viewing
from beags_plugin.system.errors import UserError


class ShownFiles:
    """Writer of the part that ``viewing`` shows, in a thread of its own, one file at a time.

    title, format_name: return the file's name and its format. report: receives messages. part: returns the Gaussians of
    the file; if None, all that are shown in full. scale_by: returns the size: see ``PoseOptions``.
    """

    def __init__(
        self,
        viewing: Viewing,
        title: Callable[[], str],
        format_name: Callable[[], str],
        report: Callable[[str], None],
        part: Callable[[], Visible] | None = None,
        scale_by: Callable[[], str] = str,
    ) -> None:
        self._viewing = viewing
        self._part = part or (lambda: viewing.copy(rest=False))
        self._title = title
        self._format_name = format_name
        self._scale_by = scale_by
        self._report = report
        self._busy = threading.Lock()

    def start(self) -> None:
        """Begin to write; messages go to ``report``."""
        if not self._busy.acquire(blocking=False):
            self._report("The former export is still being written.")
            return
        self._report("Exporting ...")
        threading.Thread(target=self._write_and_report, name="beags export").start()  # a training waits for it

    def _write_and_report(self) -> None:
        try:
            scale_by = self._scale_by()
            message = f"Exported to {self.write(scale_by)}{', to scale.' if scale_by else ''}"
        except UserError as error:
            message = f"Not exported: {error}"
        except Exception as error:  # Nothing else reports an exception of a thread.
            message = f"Not exported ({type(error).__name__}: {error})."
        finally:
            self._busy.release()
        self._report(message)

    def write(self, scale_by: str = "") -> Path:
        """Write the part, in the size that ``scale_by`` gives it; return the file. Raises ``UserError``."""
        from beags_plugin.objects.export import export_shown

        viewing = self._viewing
        if viewing.run is None:
            raise UserError("no viewer shows this scene: use beags export.")
        scene = self._part()
        with torch.no_grad():
            return export_shown(
                viewing.run.opened(), scene.surfels, scene.class_ids, self._title(), self._format_name(),
                viewing.model.settings(), self.report_views, scale_by,
            )  # fmt: skip

    def report_views(self, done: int, total: int) -> None:
        """Report the number of rendered views of a mesh."""
        self._report(f"Exporting: {done} of {total} views are rendered.")
