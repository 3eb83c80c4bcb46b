"""Options of the scene and of its training: dataclasses and constants, without torch."""
