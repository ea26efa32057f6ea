"""What the paper reports, as functions."""
