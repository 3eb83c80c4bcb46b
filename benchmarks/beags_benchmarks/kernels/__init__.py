"""Speed of the compiled rasterizer and ops on the CPU and on a GPU."""
