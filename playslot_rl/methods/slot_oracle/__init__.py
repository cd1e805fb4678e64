"""Slot oracle and slot BC: real actions cloned from slots."""
