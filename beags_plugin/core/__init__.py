"""Maths of cameras, Gaussians and scenes: torch and numpy only, no nerfstudio."""
