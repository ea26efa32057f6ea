"""Experiments of the paper, and the demo, as functions."""
