"""The force laws of a scene, one file each."""
