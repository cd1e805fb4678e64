"""What the models of the video comparison share: one protocol, one stage's clips."""
