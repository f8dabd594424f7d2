"""What scenes really do: two codes for each that share nothing but the description of the robot."""
