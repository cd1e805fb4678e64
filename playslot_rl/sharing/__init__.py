"""Policies that leave the repository: the model folder, its card, and the policy as others call it."""
