"""Demonstrations: the container, files, alignment, and made ones."""
