"""The config of ``ns-train beags``: its fields and checks, how it is saved and loaded, and the lock of its run."""
