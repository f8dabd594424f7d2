"""`python -m ce_gym new`: a first YAML file for a URDF or MJCF file, and the guesses in it."""
