"""Stages between base training and refinement: consistent labels, classes and grids."""
