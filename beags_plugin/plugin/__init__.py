"""What nerfstudio sees of beags; every ns-* command that meets a run of ours imports this package."""

from beags_plugin.plugin import nerfstudio_patches  # noqa: F401  (lets torch load nerfstudio's own checkpoints)
from beags_plugin.system.errors import print_user_errors_plainly

print_user_errors_plainly()
