"""Fronts of the compiled ops: each checks its arguments once, by name, and allocates; ``native/`` computes.

An op has one name: its module here, its function or class inside, its C++ file, its test. All of them have a torch
version beside their user, which is the reference and runs where ``extension.load()`` gives None.
"""
