"""What is wrong with the masks of a scene, found before training on them; nothing of nerfstudio."""
