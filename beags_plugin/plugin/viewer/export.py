"""Files of what a viewer shows, written beside it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import torch

from beags_plugin.plugin.viewer.viewing import Viewing
from beags_plugin.system.errors import UserError


class ShownFiles:
    """Writes what ``viewing`` shows, in a thread of its own, one file at a time.

    title, format_name: give what the file is to be called and its format. say: is told in a sentence how it goes.
    """

    def __init__(
        self, viewing: Viewing, title: Callable[[], str], format_name: Callable[[], str], say: Callable[[str], None]
    ) -> None:
        self._viewing = viewing
        self._title = title
        self._format_name = format_name
        self._say = say
        self._busy = threading.Lock()

    def start(self) -> None:
        """Begin; ``say`` is told the rest."""
        if not self._busy.acquire(blocking=False):
            self._say("The former export is still being written.")
            return
        self._say("Exporting ...")
        threading.Thread(target=self._write_and_say, name="beags export", daemon=True).start()

    def _write_and_say(self) -> None:
        try:
            said = f"Exported to {self.write()}"
        except UserError as error:
            said = f"Not exported: {error}"
        except Exception as error:  # a thread has nobody else to tell
            said = f"Not exported ({type(error).__name__}: {error})."
        finally:
            self._busy.release()
        self._say(said)

    def write(self) -> Path:
        """Write what is shown in full, inside the crop box; returns the file. Raises ``UserError``."""
        from beags_plugin.plugin.objects.export import export_shown

        viewing = self._viewing
        if viewing.run is None:
            raise UserError("no viewer shows this scene: use beags export.")
        scene = viewing.copy(rest=False)
        config_path = viewing.run.folder / "config.yml"
        with torch.no_grad():
            return export_shown(
                config_path, scene.surfels, scene.class_ids, f"shown_{self._title()}", self._format_name(),
                viewing.model.settings(), self.say_views,
            )  # fmt: skip

    def say_views(self, done: int, total: int) -> None:
        """Tell how many of the views are drawn that a mesh is made of."""
        self._say(f"Exporting: {done} of {total} views are drawn.")
