"""The targets of nerfstudio's entry points: one MethodSpecification per preset, built on access."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from beags_plugin.plugin.presets import load_preset, preset_names


def __getattr__(name: str) -> MethodSpecification:
    preset = name.replace("_", "-")
    if preset not in preset_names():
        raise AttributeError(f"there is no preset {preset!r}")
    return load_preset(preset)
