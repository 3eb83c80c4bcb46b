"""What nerfstudio's entry points load: one MethodSpecification per preset, built when it is asked for."""

from __future__ import annotations

from nerfstudio.plugins.types import MethodSpecification

from beags_plugin.plugin.presets import load_preset


def __getattr__(name: str) -> MethodSpecification:
    if name.startswith("__"):
        raise AttributeError(name)
    return load_preset(name.replace("_", "-"))
