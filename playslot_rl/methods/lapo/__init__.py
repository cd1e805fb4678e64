"""LAPO: latent actions from pixels, holistic."""
