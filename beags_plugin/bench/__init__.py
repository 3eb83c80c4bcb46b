"""Experiments: trials that share trained bases, run one after the other, told as tables, files and pictures."""
