"""Single programs for measurements; README.md of this distribution lists them."""
