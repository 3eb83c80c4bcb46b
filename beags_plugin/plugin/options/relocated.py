"""The place of a run that an ns-* command opens, by its command line."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from beags_plugin.runs.layout import newest_checkpoint
from beags_plugin.runs.relocation import check_data, relocate
from beags_plugin.system.errors import print_user_errors_plainly
from beags_plugin.system.program import path_option, program_name

_named: list[Path] = []  # Files config.yml named by ``named``.


@contextmanager
def named(config_path: Path) -> Iterator[None]:
    """Name the config.yml that nerfstudio's functions, such as ``eval_setup``, read in this block.

    They pass PyYAML only the text of the file. In nerfstudio's programs the option --load-config names the file, which
    a moved run needs; Python code has no such option.
    """
    _named.append(config_path)
    try:
        yield
    finally:
        _named.pop()


def place_for_nerfstudio(config: Any) -> None:
    """Set the place of a run whose config an ns-* command reads from YAML to the folder of its --load-config.

    config: a ``BeagsTrainerConfig``.
    """
    path = _named[-1] if _named else path_option("--load-config")
    if path is None:
        return
    if program_name() == "ns-train" and not _named:
        relocate(config, path, path_option("--data"))
        config.overwrite = "--overwrite" in sys.argv and path_option("--overwrite") != Path("False")
        return
    print_user_errors_plainly()
    relocate(config, path, None)
    newest_checkpoint(config.get_checkpoint_dir())
    check_data(config.data_path, path)
