"""Programs that measure one thing each: README.md of this distribution lists them."""
