"""Mistakes that users make, as data: how each is made, and with which command (see ``table``)."""
