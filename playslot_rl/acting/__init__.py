"""Acting: the actor, the environments of simulator and imagination, and the loop over episodes."""
