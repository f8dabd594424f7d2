"""What a task may ask about a robot: rewards, observations, terminations and metrics, and the context they read."""
