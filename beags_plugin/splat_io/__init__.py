"""Files of splats, read and written, and their frames."""
