"""What nerfstudio sees of beags; every ns-* command that meets a run of ours imports this package."""

from beags_plugin.system.errors import print_user_errors_plainly

print_user_errors_plainly()
