"""ACT and Diffusion Policy: LeRobot's own classes on the labelled demonstrations alone."""
