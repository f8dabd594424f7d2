"""What a robot's transmissions are and what a scene costs, in figures and in words."""
