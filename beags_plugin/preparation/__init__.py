"""Stages between base training and refinement: consistent labels, classes, grids (method, sections 2, 3 and 5)."""
