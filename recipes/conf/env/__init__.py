"""The `env` group: one YAML a task."""
