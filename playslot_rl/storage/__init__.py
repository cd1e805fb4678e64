"""The ground floor: atomic writes, tensors, checkpoints, provenance."""
