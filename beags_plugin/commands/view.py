"""``beags view``: a run in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from beags_plugin.commands.starting import run_config, starting


@dataclass
class View:
    """Look at a run in the browser, pick and export objects; safe for runs of other people.

    Nothing that its files name is executed, and only this computer is served. Ctrl-C ends it.
    """

    run_folder: tyro.conf.Positional[Path]
    """Folder of the run (or its config.yml)."""
    port: int | None = None
    """Port of this computer; the first free one from 7007 on if left out."""
    data: Path | None = None
    """Folder of the photos, if not where the run was trained on them."""
    save_to: Path | None = None
    """Folder for Save as masks, which then ends the viewer: how beags demo --pick asks for objects."""
    expect: tuple[str, ...] = ("object 1",)
    """With --save-to: the objects to be picked, under these names if they get no others."""

    def run(self) -> None:
        with starting(self):
            from beags_plugin.plugin.viewer.errand import Errand
            from beags_plugin.plugin.viewer.serve import serve
        errand = None if self.save_to is None else Errand(self.save_to.absolute(), self.expect)
        serve(run_config(self.run_folder), self.data, self.port, errand)
