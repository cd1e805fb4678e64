"""Policies on the frozen code of an encoder that has seen unlabelled videos: an autoencoder's, and a ResNet-18's."""
