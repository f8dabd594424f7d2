"""Tasks: data, actions, commands, ground, randomisation and curriculum, as traced functions."""
