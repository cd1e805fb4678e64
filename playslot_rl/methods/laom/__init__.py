"""LAOM: latent actions in a latent space, which a few real actions supervise."""
