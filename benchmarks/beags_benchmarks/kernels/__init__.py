"""How fast the compiled rasterizer and ops are, on the CPU and on a GPU."""
