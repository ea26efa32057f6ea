"""Files that are there whole or not at all, and the memory that reading takes."""
