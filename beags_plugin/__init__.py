"""BEA-GS: clean object extraction from Gaussian-splat scenes, as a nerfstudio plugin.

Importing this package imports nothing heavy: every ns-* command pays for it at start-up.
"""

__version__ = "0.2.0"
