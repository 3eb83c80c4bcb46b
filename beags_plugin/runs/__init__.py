"""A run on disk: opened once, each part read at its first use; without nerfstudio."""
