"""What acts on a robot: contacts, motors, springs and stops, each linearly implicit, and the scene they belong to."""
