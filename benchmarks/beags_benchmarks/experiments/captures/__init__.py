"""``beags bench captures``: refinement on real captures, scored by silhouettes traced by eye."""
