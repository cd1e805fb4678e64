"""Predictors of the next frame's slots."""
