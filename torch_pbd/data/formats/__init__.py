"""File formats of demonstrations."""
