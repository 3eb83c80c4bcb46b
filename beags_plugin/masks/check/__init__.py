"""Checks of the masks of a scene before training."""
