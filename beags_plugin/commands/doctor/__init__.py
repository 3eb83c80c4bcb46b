"""``beags doctor``: checks of the installation, and the one command that repairs each failure."""
