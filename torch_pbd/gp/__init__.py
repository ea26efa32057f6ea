"""Batches of independent Gaussian processes over the same inputs: eq. (3) to (6), and their evidence."""
