"""Slot oracle and ResNet oracle: real actions cloned from slots and from ResNet-18 features."""
