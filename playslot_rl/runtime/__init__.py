"""The machine: processes and threads, memory, devices, precision."""
