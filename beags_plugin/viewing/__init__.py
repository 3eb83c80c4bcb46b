"""What a viewer shows of a scene: a choice of objects, what is under the cursor, pictures of what the losses see."""
