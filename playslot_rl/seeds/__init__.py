"""Seeds: of every draw of a training, and of every episode."""
