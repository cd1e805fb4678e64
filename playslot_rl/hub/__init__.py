"""Data sets to and from the Hugging Face Hub. `push.push` and `pull.pull` are the two ways in."""
