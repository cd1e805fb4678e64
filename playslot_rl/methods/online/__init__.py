"""What the methods that learn by acting share: replay, the loop of acting and learning, its checkpoints."""
