"""Where a run lies: beside its config.yml, whatever folder that names; and its data, which may lie elsewhere too."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from beags_plugin.plugin.runs.layout import newest_checkpoint
from beags_plugin.plugin.runs.run_config import load_run_config
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from beags_plugin.system.progress import say

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

_told: set[Path] = set()  # folders of moved runs that a line has named


def open_run(config_path: Path, data: Path | None = None) -> BeagsTrainerConfig:
    """Return the config of the run that lies beside its config.yml; raises ``UserError`` for another file.

    data: the photos, if not where the run was trained on them.
    """
    config = load_run_config(config_path)
    _place(config, config_path, data)
    return config


def check_data(data: Path, config_path: Path) -> None:
    """Raise ``UserError`` for data of a run that are not there. config_path: of the run."""
    if not data.exists():
        raise UserError(
            f"the data of {config_path} are not at {data}: name their place with --data (ns-* commands, which have no "
            f"such option, also look at {config_path.absolute().parent / _name(data)})."
        )


def place_for_nerfstudio(config: BeagsTrainerConfig) -> None:
    """Place a config that ``eval_setup`` (of all ns-* commands) or ns-train reads from YAML; leave others alone.

    Both hand PyYAML a text, not a file, so that only their own variables know where it is from.
    """
    frame = sys._getframe(2)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("yaml"):
        frame = frame.f_back
    reader = (frame.f_globals.get("__name__"), frame.f_code.co_name)
    if reader == ("nerfstudio.scripts.train", "main"):
        flags = frame.f_locals["config"]
        _place(config, flags.load_config, flags.data)
        config.overwrite = getattr(flags, "overwrite", False)
    elif reader == ("nerfstudio.utils.eval_utils", "eval_setup"):
        path = Path(frame.f_locals["config_path"])
        print_user_errors_plainly()
        _place(config, path, None)
        newest_checkpoint(config.get_checkpoint_dir())
        check_data(config.data_path, path)


def _place(config: BeagsTrainerConfig, config_path: Path, data: Path | None) -> None:
    folder, trained_in, recorded = config_path.absolute().parent, config.get_base_dir(), config.data_path
    config.run_dir = folder  # checkpoints, and all that is written
    found = recorded if data is None else data
    if data is None and not recorded.exists():
        near = [folder / os.path.relpath(recorded, trained_in)]  # where it would be if all was moved together
        near += [parent / _name(recorded) for parent in (folder, *folder.parents[:2])]  # for base and extracted too
        found = next((place.resolve() for place in near if place.exists()), recorded)
    if found != recorded:
        config.data_config.data = config.data_config.dataparser.data = found
    if folder.resolve() != trained_in.resolve() and not _told.intersection((folder, *folder.parents)):
        _told.add(folder)
        say(f"This run was trained in {trained_in}; it is read, and written to, where it lies now: {folder}")


def _name(data: Path) -> Path:
    """Return what is left of the data's path if their folder is moved."""
    return Path(data.parent.name, data.name) if data.suffix == ".json" else Path(data.name)
