"""A run's life: the scene, its phases, checkpoints and curves."""
