"""The folder of a run as it was before a training: restored where the training is refused with nothing saved."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path

from beags_plugin.system.lock import LOCK

REPLACED = "replaced_models"
"""Folder of a run: checkpoints of an earlier one in the same place, until the new one has its own."""
_MODELS = "nerfstudio_models"
_REWRITTEN = ("config.yml", "training.json", "dataparser_transforms.json", "start.json", "held_out.json")
_ADDED = (LOCK, "events.out.tfevents.*", "prepared", "base", "wandb")
"""What a training writes before its first checkpoint; other programs may write into the folder too."""

_noted: dict[Path, Rollback] = {}


class Rollback:
    """Notes what is in the folder of a run; make it before a training writes there, and undo under the run's lock."""

    def __init__(self, run: Path) -> None:
        self.run = run.absolute()
        self._absent = [each for each in (self.run, *self.run.parents) if not each.exists()]
        self._files = {path: path.read_bytes() for name in _REWRITTEN if (path := self.run / name).is_file()}
        self._others = {path for pattern in _ADDED for path in self.run.glob(pattern)}
        self._saved = set(self.run.glob(f"{_MODELS}/*.ckpt"))

    def undo(self) -> bool:
        """Take back what was written since; does nothing, and returns False, where a checkpoint has been saved."""
        models = self.run / _MODELS
        if set(models.glob("*.ckpt")) - self._saved:
            return False
        with suppress(OSError):  # of the disk that the refusal is about
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
    """Note the folder of a run for the training of this process that is about to begin there."""
    _noted[run.absolute()] = Rollback(run)


def noted(run: Path) -> Rollback:
    """Return what was noted of a run; it is noted now if that has not been done."""
    return _noted.pop(run.absolute(), None) or Rollback(run)
