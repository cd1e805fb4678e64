"""The shipped YAML: `config.yaml` and the groups `env` and `preset`."""
