"""Generated scenes to measure with: families of scenes, photos that differ, masks that share errors."""
