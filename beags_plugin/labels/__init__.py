"""Class ids of pixels and Gaussians: names, colours, maps of all views."""
