"""First step of every command: reject wrong arguments at once, and show that the command has begun.

torch and nerfstudio take seconds to import, so only quick checks are made here; the code that uses an argument checks
it fully.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, get_args

import yaml
from rich.console import Console

from beags_plugin.data import LAYOUTS
from beags_plugin.export import EXPORTERS
from beags_plugin.masks.sources import MASK_SOURCES
from beags_plugin.options.run_format import CONFIG_FILE
from beags_plugin.pictures.options import PictureFormat, RenderOptions
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.reading.text import reason
from beags_plugin.system.shipped import shipped_names

NERFSTUDIO_REPAIR = "pip install nerfstudio==1.1.5"
LARGEST_CONFIG = 1 << 20  # Bytes; a run's config has some 20,000.


@contextmanager
def starting(command: Any, nerfstudio: bool = False) -> Iterator[None]:
    """Check the arguments of a command; then show a spinner while the block imports what the command needs.

    A run that is named by its folder becomes its config.yml. nerfstudio: whether the command trains or opens the
    viewer. Raises ``UserError``.
    """
    check_arguments(command)
    if not nerfstudio:  # Threads that wait actively shorten the many small steps of training, and only those.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # torch's OpenMP reads it when it is loaded
    if nerfstudio and find_spec("nerfstudio") is None:
        raise UserError(
            f"beags {type(command).__name__.lower()} needs nerfstudio, which is not installed here: "
            f"{NERFSTUDIO_REPAIR}, or use the environment of make setup."
        )
    with Console(stderr=True).status("starting"):
        yield


def check_arguments(command: Any) -> None:
    """Raise ``UserError`` for a field of a command that names an unusable run, scene or choice."""
    values = vars(command)
    if load_config := values.get("load_config"):
        command.load_config = run_config(load_config)
    if (run := values.get("run_folder")) is not None:
        run_config(run)
    if (data := values.get("data")) is not None and not data.exists():
        raise UserError(f"the data folder {data} does not exist: give --data the folder that holds the scene.")
    if (preset := values.get("preset")) is not None:
        check_choice(preset, shipped_names("method_configs"), "preset")
    if (layout := values.get("layout")) not in (None, "auto"):
        LAYOUTS.check(layout, "auto")
    if (source := values.get("source")) is not None:
        MASK_SOURCES.check(source)
    if isinstance(options := values.get("pictures"), RenderOptions):
        check_choice(values["format"], get_args(PictureFormat), "format")
        options.check()
    else:
        for name in values.get("format", ()):
            EXPORTERS.check(name)


def run_config(path: Path) -> Path:
    """Return the config.yml of a run, named by itself or by its folder; raises ``UserError`` for another file."""
    path = path / CONFIG_FILE if path.is_dir() else path
    try:
        with path.open("rb") as file:
            text = file.read(LARGEST_CONFIG)
        root = yaml.compose(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({reason(error)}): name the config.yml of a run.") from error
    except (yaml.YAMLError, ValueError, RecursionError):
        return path  # Its reader has an error message for it.
    if root is None or not root.tag.startswith("tag:yaml.org,2002:python/object:"):
        raise UserError(f"{path} is not a run of ns-train beags: name the config.yml of one.")
    return path
