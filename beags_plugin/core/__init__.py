"""Maths of cameras, surfels and scenes: torch and numpy only, no nerfstudio."""
