"""Predicted frames, by the number of seed frames."""
