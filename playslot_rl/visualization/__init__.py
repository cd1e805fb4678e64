"""Pictures of slots, rollouts and prototypes, and the report of a run."""
