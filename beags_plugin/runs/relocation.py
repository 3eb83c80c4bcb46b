"""Where a run lies: beside its config.yml, whatever folder that names; and its data, which may lie elsewhere too."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from beags_plugin.runs.run_config import RunConfig, read_run_config
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say

_told: set[Path] = set()  # folders of moved runs that a line has named


class Placed(Protocol):
    """A config that knows where its run and its data lie: ``RunConfig``, or nerfstudio's."""

    run_dir: Path | None

    @property
    def data_config(self) -> Any: ...

    @property
    def data_path(self) -> Path: ...

    def get_base_dir(self) -> Path: ...


def open_run(config_path: Path, data: Path | None = None) -> RunConfig:
    """Return the config of the run that lies beside its config.yml; raises ``UserError`` for another file.

    data: the photos, if not where the run was trained on them.
    """
    config = read_run_config(config_path)
    relocate(config, config_path, data)
    return config


def check_data(data: Path, config_path: Path) -> None:
    """Raise ``UserError`` for data of a run that are not there. config_path: of the run."""
    if not data.exists():
        raise UserError(
            f"the data of {config_path} are not at {data}: name their place with --data (ns-* commands, which have no "
            f"such option, also look at {config_path.absolute().parent / _name(data)})."
        )


def relocate(config: Placed, config_path: Path, data: Path | None) -> None:
    """Set the folder of a run to where its config.yml lies, and its data to where they are found."""
    folder, trained_in, recorded = config_path.absolute().parent, config.get_base_dir(), config.data_path
    config.run_dir = folder  # checkpoints, and all that is written
    found = recorded if data is None else data
    if data is None and not recorded.exists():
        near = [folder / os.path.relpath(recorded, trained_in)]  # where it would be if all was moved together
        near += [parent / _name(recorded) for parent in (folder, *folder.parents[:2])]  # base and extracted lie deeper
        found = next((place.resolve() for place in near if place.exists()), recorded)
    if found != recorded:
        config.data_config.data = config.data_config.dataparser.data = found
    if folder.resolve() != trained_in.resolve() and not _told.intersection((folder, *folder.parents)):
        _told.add(folder)
        say(f"This run was trained in {trained_in}; it is read, and written to, where it lies now: {folder}")


def _name(data: Path) -> Path:
    """Return what is left of the data's path if their folder is moved."""
    return Path(data.parent.name, data.name) if data.suffix == ".json" else Path(data.name)
