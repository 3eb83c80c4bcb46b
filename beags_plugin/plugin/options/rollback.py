"""Restore the folder of a run if a training is refused before it has saved anything."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

from beags_plugin.system.lock import LOCK

REPLACED = "replaced_models"
"""Folder in a run for the checkpoints of an earlier run, until the new one has its own."""
_MODELS = "nerfstudio_models"
_REWRITTEN = ("config.yml", "training.json", "dataparser_transforms.json", "start.json")
_ADDED = (LOCK, "events.out.tfevents.*", "prepared", "base", "wandb")
"""Files that a training adds before its first checkpoint; other programs may write into the folder too."""

_noted: dict[Path, Rollback] = {}


class Rollback:
    """The content of a run's folder before a training writes there; call ``undo`` under the run's lock."""

    def __init__(self, run: Path) -> None:
        self.run = run.absolute()
        self._absent = [each for each in (self.run, *self.run.parents) if not each.exists()]
        self._files = {path: path.read_bytes() for name in _REWRITTEN if (path := self.run / name).is_file()}
        self._others = {path for pattern in _ADDED for path in self.run.glob(pattern)}
        self._saved = set(self.run.glob(f"{_MODELS}/*.ckpt"))

    def undo(self) -> bool:
        """Undo what was written since; do nothing and return False if a checkpoint has been saved."""
        models = self.run / _MODELS
        if set(models.glob("*.ckpt")) - self._saved:
            return False
        with suppress(OSError):  # The disk may be why the training was refused.
            for path in {self.run / name for name in _REWRITTEN} - set(self._files):
                path.unlink(missing_ok=True)
            for path in {path for pattern in _ADDED for path in self.run.glob(pattern)} - self._others:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            for path, content in self._files.items():
                if not path.is_file() or path.read_bytes() != content:
                    path.write_bytes(content)
            if self._saved and not models.exists():
                (self.run / REPLACED).rename(models)
            for folder in ([models] if not self._saved else []) + self._absent:
                if folder.is_dir():
                    folder.rmdir()
        return True


def note(run: Path) -> None:
    """Record the folder of a run before this process trains there."""
    _noted[run.absolute()] = Rollback(run)


def noted(run: Path) -> Rollback:
    """Return the record of a run's folder, made now if there is none."""
    return _noted.pop(run.absolute(), None) or Rollback(run)
