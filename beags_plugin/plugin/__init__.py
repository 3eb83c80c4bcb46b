"""The plugin as nerfstudio sees it; every ns-* command that meets a run of ours imports this package."""
