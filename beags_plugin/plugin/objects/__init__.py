"""Work with finished runs: extract, export, evaluate, render, masks."""
