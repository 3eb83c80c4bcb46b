"""``beags bench paper``: the paper's tables, from its data sets as far as they are on disk."""
