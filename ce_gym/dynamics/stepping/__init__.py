"""A time step made of the recursions and the forces, and its methods."""
