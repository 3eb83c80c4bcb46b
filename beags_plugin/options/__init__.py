"""Options of the scene and of its training: data, without behaviour."""
