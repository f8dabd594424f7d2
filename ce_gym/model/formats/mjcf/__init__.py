"""MJCF, through the package `mujoco` (extra `mjcf`)."""
