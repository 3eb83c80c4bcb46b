"""Measurements of beags: experiments (``beags bench``), and studies, each a program of its own."""
