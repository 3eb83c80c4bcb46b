"""Errors, files, processes and devices: modules that know nothing of scenes."""
