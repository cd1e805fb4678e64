"""The `env_preset` group: what a task changes in one preset (`<env>_<preset>.yaml`, optional); applied last."""
