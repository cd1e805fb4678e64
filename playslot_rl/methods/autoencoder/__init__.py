"""Autoencoder BC: real actions cloned from the frozen features of an autoencoder of unlabelled videos."""
