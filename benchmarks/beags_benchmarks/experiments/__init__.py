"""Experiments: trials that share trained bases, run one after the other, reported as tables, files and pictures."""
