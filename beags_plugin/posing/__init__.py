"""Poses from photos: features, pairs, structure from motion by pycolmap, and the files that ns-train reads."""
