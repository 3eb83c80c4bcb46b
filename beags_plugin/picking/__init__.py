"""Objects picked out of a trained scene by a few prompts, without masks."""
