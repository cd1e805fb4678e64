"""ResNet oracle and ResNet BC: real actions cloned from frames."""
