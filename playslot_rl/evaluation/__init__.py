"""Evaluation: success in simulation and in imagination, video metrics, latent-action probes."""
