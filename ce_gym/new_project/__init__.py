"""`python -m ce_gym project`: a package of one's own with a robot and a task."""
