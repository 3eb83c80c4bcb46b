"""The methods that ``ns-train`` lists: one nerfstudio ``MethodSpecification`` per preset.

The entry points in pyproject.toml name attributes of this module, such as ``beags_fast``. Each is built from the
preset's file, such as ``method_configs/beags-fast.toml``, when nerfstudio reads the attribute.
"""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from beags_plugin.plugin.presets import load_preset, preset_names


def __getattr__(name: str) -> MethodSpecification:
    """Return the preset ``name``, with underscores for hyphens; raises ``AttributeError`` if there is none."""
    preset = name.replace("_", "-")
    if preset not in preset_names():
        raise AttributeError(f"there is no preset {preset!r}")
    return load_preset(preset)
