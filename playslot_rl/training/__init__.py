"""The training machinery: one fit loop, optimiser and schedule, checkpoints, logging, seeding, atomic writes."""
