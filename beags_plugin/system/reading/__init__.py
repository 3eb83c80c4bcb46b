"""Readers of untrusted files: nothing in a file is executed, and the sizes that it states are checked first."""
