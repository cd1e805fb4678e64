"""Reading data: LeRobot data sets, the frame cache, the slot cache, window sampling."""
