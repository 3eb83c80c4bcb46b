"""A run on disk: its files, how they are written and read."""
