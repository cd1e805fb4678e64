"""Data sets (`push`, `pull`) and policies (`push_policy`, `pull_policy`) to and from the Hugging Face Hub."""
