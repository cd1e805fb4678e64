"""The `env_model` group: what a task changes in any preset (`<env>.yaml`, optional); applied after the preset."""
