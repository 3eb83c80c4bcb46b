"""Commands of ``beags``, one a file."""
