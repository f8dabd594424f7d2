"""Meshes of a robot's own files: which there are, and their triangles."""
