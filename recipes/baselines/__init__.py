"""Recipes of the baselines, one module a method: `main(config)` trains it."""
