"""CADDY: playable video generation, discrete actions with a continuous variability, on whole frames."""
