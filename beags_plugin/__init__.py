"""BEA-GS: clean object extraction from Gaussian-splat scenes, as a nerfstudio plugin.

Importing it loads no torch and no nerfstudio, because every ns-* command imports it at its start. docs/architecture.md
says which folder holds what.
"""

__version__ = "0.2.0"
