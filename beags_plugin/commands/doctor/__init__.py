"""``beags doctor``: what works here, what is missing, and the one command that repairs each."""
