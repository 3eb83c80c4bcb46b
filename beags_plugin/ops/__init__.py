"""Fronts of the compiled ops: each checks its arguments once, by name, and allocates; ``native/`` computes.

An op has one name: its module here, the function or class inside it and in C++. So have its C++ file and its test, but
for the two image losses (``photometric``, ``normal_consistency``: ``image_losses.cpp``, ``test_image_ops.py``) and the
test of the voxel votes, in ``test_reprojection_votes.py``. All of them have a torch version beside their user, which is
the reference and runs where ``extension.load()`` gives None.
"""
