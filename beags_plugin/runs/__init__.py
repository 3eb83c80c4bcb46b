"""A run on disk: opened once, each part read when it is first asked for; without nerfstudio."""
