"""Meshes of robot files."""
