"""Studies: methods side by side, by one engine of jobs and several measures."""
