"""Reference solutions: two codes for each scene that share only the description of the robot."""
