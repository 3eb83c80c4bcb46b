"""The plugin as nerfstudio sees it; every ns-* command that meets a run of ours imports this package."""

from beags_plugin.plugin import nerfstudio_patches  # noqa: F401  (torch then loads nerfstudio's own checkpoints)
