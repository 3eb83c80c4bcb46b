"""Measurements of the compiled code: see README.md in this folder."""
