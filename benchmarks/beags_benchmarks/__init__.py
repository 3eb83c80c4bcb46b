"""Measurements of beags: experiments (``beags bench``), and studies, a program each."""
