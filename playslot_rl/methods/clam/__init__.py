"""CLAM: continuous latent actions, learned together with their decoder."""
