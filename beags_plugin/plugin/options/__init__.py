"""Options of ``ns-train beags``: fields and checks, no behaviour."""
