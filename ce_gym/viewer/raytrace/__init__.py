"""Pictures of robots without a display: rays and triangles on the CPU."""
