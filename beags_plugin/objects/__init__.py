"""What is done to a finished run: extract, export, evaluate, render, masks, pose; without nerfstudio."""
