"""Where a run lies: beside its config.yml, whatever folder that names; and its data, which may lie elsewhere too."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from beags_plugin.plugin.runs.layout import newest_checkpoint
from beags_plugin.plugin.runs.run_config import RunConfig, load_run_config, read_run_config
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from beags_plugin.system.progress import say

if TYPE_CHECKING:
    from beags_plugin.plugin.options.config import BeagsTrainerConfig

_named: list[Path] = []  # config.yml files that Python code has said it reads
_told: set[Path] = set()  # folders of moved runs that a line has named


def open_run(config_path: Path, data: Path | None = None) -> RunConfig:
    """Return the config of the run that lies beside its config.yml; raises ``UserError`` for another file.

    data: the photos, if not where the run was trained on them.
    """
    config = read_run_config(config_path)
    _place(config, config_path, data)
    return config


def open_for_training(config_path: Path, data: Path | None = None) -> BeagsTrainerConfig:
    """Do as ``open_run``, for nerfstudio."""
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


@contextmanager
def named(config_path: Path) -> Iterator[None]:
    """Say which config.yml nerfstudio's functions, such as ``eval_setup``, read in this block.

    Its programs hand PyYAML a text, so that a run which was moved is found by the --load-config of the command line;
    Python code that calls them has none.
    """
    _named.append(config_path)
    try:
        yield
    finally:
        _named.pop()


def place_for_nerfstudio(config: BeagsTrainerConfig) -> None:
    """Place a config that an ns-* command reads from YAML where its --load-config says that the run lies."""
    path = _named[-1] if _named else _option("--load-config")
    if path is None:
        return
    if Path(sys.argv[0]).stem == "ns-train" and not _named:
        _place(config, path, _option("--data"))
        config.overwrite = "--overwrite" in sys.argv and _option("--overwrite") != Path("False")
        return
    print_user_errors_plainly()
    _place(config, path, None)
    newest_checkpoint(config.get_checkpoint_dir())
    check_data(config.data_path, path)


def _option(name: str) -> Path | None:
    """Return the path that this program's command line gives an option, spelt with - or _; None where it does not."""
    words = sys.argv[1:]
    for index, word in enumerate(words):
        option, equals, value = word.partition("=")
        if option.replace("_", "-") == name and (equals or index + 1 < len(words)):
            return Path(value if equals else words[index + 1])
    return None


def _place(config: RunConfig | BeagsTrainerConfig, config_path: Path, data: Path | None) -> None:
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
