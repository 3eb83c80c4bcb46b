"""Place of a run, which is beside its config.yml whatever that file says, and of its data."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from beags_plugin.runs.run_config import RunConfig, read_run_config
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say

_announced: set[Path] = set()  # Folders of moved runs that a line has named.


class AnyConfig(Protocol):
    """The config of a run: ``RunConfig``, or ``BeagsTrainerConfig`` for nerfstudio."""

    run_dir: Path | None
    relative_model_dir: Path

    @property
    def data_config(self) -> Any: ...

    @property
    def data_path(self) -> Path: ...

    def get_base_dir(self) -> Path: ...

    def text_in(self, folder: Path) -> str: ...


def open_run(config_path: Path, data: Path | None = None) -> RunConfig:
    """Return the config of the run that lies beside its config.yml; raises ``UserError`` for another file.

    data: folder of the photos, if they were moved.
    """
    config = read_run_config(config_path)
    relocate(config, config_path, data)
    return config


def check_data(data: Path, config_path: Path) -> None:
    """Raise ``UserError`` if a run's data do not exist. config_path: of the run."""
    if not data.exists():
        raise UserError(
            f"the data of {config_path} are not at {data}: name their place with --data (ns-* commands, which have no "
            f"such option, also look at {config_path.absolute().parent / _name(data)})."
        )


def relocate(config: AnyConfig, config_path: Path, data: Path | None) -> None:
    """Set the folder of a run to that of its config.yml, and its data to where they lie now."""
    folder, trained_in, recorded = config_path.absolute().parent, config.get_base_dir(), config.data_path
    config.run_dir = folder
    data_path = recorded if data is None else data
    if data is None and not recorded.exists():
        near = [folder / os.path.relpath(recorded, trained_in)]  # Run and data may have been moved together.
        # Runs in base/ and extracted/ lie deeper.
        near += [parent / _name(recorded) for parent in (folder, *folder.parents[:2])]
        data_path = next((place.resolve() for place in near if place.exists()), recorded)
    if data_path != recorded:
        config.data_config.data = config.data_config.dataparser.data = data_path
    if folder.resolve() != trained_in.resolve() and not _announced.intersection((folder, *folder.parents)):
        _announced.add(folder)
        say(f"This run was trained in {trained_in}; it is read, and written to, where it lies now: {folder}")


def _name(data: Path) -> Path:
    """Return the part of the data's path that stays the same if their folder is moved."""
    return Path(data.parent.name, data.name) if data.suffix == ".json" else Path(data.name)
