"""Photos and poses become nerfstudio's views."""
