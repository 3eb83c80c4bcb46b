"""Errors, files, processes and devices: what knows nothing of scenes."""
