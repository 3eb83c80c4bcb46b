"""Surfaces of objects: fused, closed, placed by the photos, textured."""
