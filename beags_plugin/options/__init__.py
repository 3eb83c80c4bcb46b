"""Options of the scene and of its training, and their checks, without nerfstudio."""
