"""Presets: the files of method_configs/, each a short list of overrides of the base config."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from nerfstudio.plugins.types import MethodSpecification

from beags_plugin.plugin.options.config import BeagsTrainerConfig, base_config
from beags_plugin.system.errors import UserError, meant
from beags_plugin.system.shipped import read_toml, shipped_folder, shipped_names

FIRST_OPTIONS = {
    "--data FOLDER": "the scene: photos, poses, masks",
    "--load-dir RUN/nerfstudio_models": "refine, or go on with, a run on the same data",
    "--pipeline.model.start-from FILE": "refine a scene of another program (.ply)",
    "--pipeline.model.base-steps N": "length of the base; its schedule is scaled",
    "--pipeline.model.refine-steps N": "length of the refinement; 0 trains a base only",
    "--pipeline.model.densify.max-surfels N": "most Gaussians: bounds time and memory",
    "--run-dir FOLDER": "where the run goes",
    "--vis viewer+tensorboard": "what to watch it with",
    "--machine.device-type cpu|cuda": "where it is trained",
    "beags-data --masks-path FOLDER": "the id images, if not masks/",
    "beags-data --ignore-ids ID ...": 'ids in the masks that mean "not labelled"',
    "beags-data --downscale-factor 2": "smaller photos: less time, less detail",
}
"""The options that people set first, with their use; options of beags-data go to the end of the command."""


def preset_names() -> list[str]:
    """Return the names of all presets."""
    return shipped_names("method_configs")


def load_preset(name: str, folder: Path | None = None) -> MethodSpecification:
    """Return the method of ``<folder>/<name>.toml``.

    The file has a ``description``, a table ``[overrides]`` of dotted config keys, and perhaps ``like``, the name of a
    preset whose overrides apply first. Raises ``UserError`` for a file that cannot be read, for a key that the base
    config does not have, and for presets that are like each other.
    """
    files = preset_files(name, folder)
    config = base_config()
    config.method_name = name
    for path in reversed(files):
        for key, value in _read(path).get("overrides", {}).items():
            override(config, key, value, path)
    return MethodSpecification(config=config, description=_description(name, _read(files[0])["description"]))


def preset_files(name: str, folder: Path | None = None) -> list[Path]:
    """Return the files that make up a preset: its own, that of the preset it is like, and so on."""
    files: list[Path] = []
    while name:
        path = (folder or shipped_folder("method_configs")) / f"{name}.toml"
        if path in files:
            raise UserError(f"the preset {files[0]} is like itself through {files[-1]}: remove one entry like.")
        files.append(path)
        name = _read(path).get("like", "")
    return files


def _read(path: Path) -> dict[str, Any]:
    content = read_toml(path, "preset")
    if unknown := set(content) - {"description", "like", "overrides"}:
        raise UserError(
            f"the preset {path} has unknown entries {sorted(unknown)}: only description, like and overrides."
        )
    return content


def _description(name: str, sentence: str) -> str:
    """Return the text above the help of ``ns-train <name>``; only that of beags lists the first options."""
    if name != "beags":
        return f"{sentence} The options that matter: ns-train beags --help."
    rows = (f"  {option:<40}{use}" for option, use in FIRST_OPTIONS.items())
    return "\n".join([sentence, "", "The options that people set first:", *rows, "", "All options follow."])


def preset_config(name: str, overrides: Mapping[str, Any], source: Path) -> BeagsTrainerConfig:
    """Return the config of a preset with more ``overrides``; a ``UserError`` about one names their file ``source``."""
    config = cast(BeagsTrainerConfig, load_preset(name).config)
    for key, value in overrides.items():
        override(config, key, value, source)
    return config


def override(config: BeagsTrainerConfig, key: str, value: Any, source: Path) -> None:
    """Set the dotted ``key`` of ``config``; raises ``UserError`` if there is no such key or its type differs."""
    *parents, last = key.split(".")
    holder: Any = config
    for name in parents:
        holder = _child(holder, name, key, source)
    current = _child(holder, last, key, source)
    if isinstance(current, tuple):
        value = tuple(value)
    if isinstance(current, float) and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if current is not None and type(value) is not type(current):
        raise UserError(f"{source}: {key} must be {type(current).__name__}, not {type(value).__name__} ({value!r}).")
    if isinstance(holder, dict):
        holder[last] = value
    elif type(holder).__dataclass_params__.frozen:
        *grandparents, parent = parents
        outer: Any = config
        for name in grandparents:
            outer = _child(outer, name, key, source)
        setattr(outer, parent, dataclasses.replace(holder, **{last: value}))
    else:
        setattr(holder, last, value)


def _child(holder: Any, name: str, key: str, source: Path) -> Any:
    known = holder if isinstance(holder, dict) else {}
    if dataclasses.is_dataclass(holder):
        known = {field.name: getattr(holder, field.name) for field in dataclasses.fields(holder)}
    if name in known:
        return known[name]
    raise UserError(f"{source}: there is no config key {key!r} ({name!r} is unknown){meant(name, known)}: correct it.")
