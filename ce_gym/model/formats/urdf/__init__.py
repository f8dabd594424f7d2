"""URDF and URDF+."""
