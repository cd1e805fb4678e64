"""Baselines behind the same interfaces."""
