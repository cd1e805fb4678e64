"""PlaySlot: the world model on slots, and the policy in its latent actions."""
