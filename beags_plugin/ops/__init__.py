"""Fronts of the compiled ops: each checks its arguments once, by name, and allocates memory; ``native/`` computes.

An op has one name: its module here, the function or class inside it and in C++, its files in ``native/ops`` and
``native/cuda/ops``, and mostly its test. Every op has a torch version beside its user, which is the reference and runs
where ``extension.load()`` returns None.
"""
