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

FIRST_OPTIONS = """
The options that people set first, by what they are about:
  data     --data FOLDER; at the end of the command: beags-data --masks-path FOLDER --downscale-factor 2
  start    --load-dir RUN/nerfstudio_models, or --pipeline.model.start-from SCENE.ply
  length   --pipeline.model.base-steps 30000, --pipeline.model.refine-steps 3000
  size     --pipeline.model.densify.max-surfels 200000
  method   --pipeline.model.refiner bea, --pipeline.model.prepare.reprojection auto
  output   --run-dir FOLDER, --vis viewer+tensorboard

All options follow; docs/training.md describes the method's own.
"""
"""Text above the help of ``ns-train beags``."""


def preset_folder() -> Path:
    """Return the folder of the preset files."""
    return shipped_folder("method_configs")


def preset_names() -> list[str]:
    """Return the names of all presets."""
    return shipped_names("method_configs")


def load_preset(name: str, folder: Path | None = None) -> MethodSpecification:
    """Return the method of ``<folder>/<name>.toml``.

    The file has a ``description`` and a table ``[overrides]`` of dotted config keys. Raises ``UserError`` for a file
    that cannot be read and for a key that the base config does not have.
    """
    path = (folder or preset_folder()) / f"{name}.toml"
    content = read_toml(path, "preset")
    if unknown := set(content) - {"description", "overrides"}:
        raise UserError(f"the preset {path} has unknown entries {sorted(unknown)}: only description and overrides.")
    config = base_config()
    config.method_name = name
    for key, value in content.get("overrides", {}).items():
        override(config, key, value, path)
    description = content["description"] + ("\n" + FIRST_OPTIONS if name == "beags" else "")
    return MethodSpecification(config=config, description=description)


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
