"""What a task is: its data, actions, commands, ground, randomisation and curriculum, as traced functions."""
