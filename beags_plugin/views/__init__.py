"""Photos, poses and masks of a scene as views; without nerfstudio."""
