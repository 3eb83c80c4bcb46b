"""A viewer that is opened to pick objects for a program that waits, such as ``beags demo --pick``."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from beags_plugin.picking.picks import Picked, Picks
from beags_plugin.system.progress import say

if TYPE_CHECKING:
    from viser import ViserServer

_PATIENCE = 5.0  # Seconds without a page after which it counts as closed, not as reloaded.
_LAST_WORDS = 1.5  # Seconds for pages to show that the masks are saved.


@dataclass(frozen=True)
class Errand:
    """Objects to pick. folder: for their masks. names: first names of the expected objects."""

    folder: Path
    names: tuple[str, ...]

    def picks(self) -> Picks:
        """Return the expected objects with nothing picked."""
        return Picks(tuple(Picked(name) for name in self.names))

    def help(self) -> str:
        """Return the tab's first text."""
        if len(self.names) == 1:
            return "Click on the object; the mouse still turns the camera. Then press Save as masks."
        return (
            f"Click on the first of {len(self.names)} objects and name it; the mouse still turns the camera. Press "
            "Another object for the next. Then press Save as masks."
        )

    def doubt(self, picks: Picks) -> str | None:
        """Return a sentence on expected objects that are not picked or named; None if none is missing."""
        missing = [one.name for one in picks.objects if not one.changed]
        picked = len(picks.objects) - len(missing)
        if picked and missing:
            return (
                f"{picked} of {len(picks.objects)} objects are picked, {', '.join(missing)} not: press Another object "
                "and click on it, or press Save as masks again to go on without."
            )
        unnamed = [one.name for one in picks.changed() if one.name in self.names]
        if unnamed and len(self.names) > 1:
            verb, own = ("has", "its own") if len(unnamed) == 1 else ("have", "their own")
            return (
                f"{', '.join(unnamed)} {verb} no name of {own} yet: choose it under Picked and write into Name, or "
                "press Save as masks again to go on."
            )
        return None

    def serve(self, server: ViserServer) -> None:
        """Open a page, or print how to open one; print a reminder when all pages are closed."""
        address = f"http://{server.get_host()}:{server.get_port()}"
        say(f"Pick in the browser: {address} (click on the object, then press Save as masks).")
        if _has_window():
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
        else:
            say(
                f"No window can be opened here. From another computer, first run there: ssh -L "
                f"{server.get_port()}:localhost:{server.get_port()} {socket.gethostname()}"
            )
        server.on_client_disconnect(lambda _: threading.Thread(target=self._left, args=(server,), daemon=True).start())

    @staticmethod
    def _left(server: ViserServer) -> None:
        time.sleep(_PATIENCE)
        if not server.get_clients():
            say(
                f"The page is closed and nothing is saved yet; what was picked is still there: open "
                f"http://{server.get_host()}:{server.get_port()} again, or press Ctrl-C to leave it for later."
            )

    def end(self, server: ViserServer) -> None:
        """End the process, once pages have shown that the masks are saved."""
        time.sleep(_LAST_WORDS)
        server.stop()
        sys.stdout.flush()
        os._exit(0)  # A normal exit would abort in a render thread inside the rasterizer.


def _has_window() -> bool:
    """Return whether a browser can show a window to the user of the terminal."""
    variables = ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform in ("darwin", "win32") or any(os.environ.get(each) for each in variables)
