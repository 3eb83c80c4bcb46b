"""The commands with which a user goes on after ``beags demo``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from beags_plugin.system.pasted import command


@dataclass(frozen=True)
class Again:
    """A demo's command, without --fresh and --strict; the fields are its options."""

    data: Path | None = None
    output: Path | None = None
    preset: str | None = None
    downscale: float | None = None
    objects: int = 1
    pick: bool = False
    mask_source: str | None = None
    mask_options: tuple[str, ...] = ()
    seed: int = 0

    def __str__(self) -> str:
        """Return the same command."""
        words = ["beags", "demo", *([] if self.data is None else ["--data", str(self.data)])]
        given = {"output": self.output, "preset": self.preset, "downscale": self.downscale, "seed": self.seed or None}
        for name, value in given.items():
            words += [] if value is None else [f"--{name}", str(value)]
        words += [] if self.objects == 1 else ["--objects", str(self.objects)]
        words += ["--pick"] if self.pick else []
        words += [] if self.mask_source is None else ["--mask-source", self.mask_source]
        return command([*words, *(["--mask-options", *self.mask_options] if self.mask_options else [])])

    def picking(self) -> str:
        """Return the command that picks the objects by clicks, so that no masks are made."""
        return str(replace(self, pick=True, mask_source=None, mask_options=()))

    def larger(self) -> str | None:
        """Return the command that trains on photos at their full size; None if this one does."""
        return None if self.downscale == 1.0 else str(replace(self, downscale=1))
