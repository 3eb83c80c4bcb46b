"""What is done with a finished run: extract, export, evaluate, render, masks."""
