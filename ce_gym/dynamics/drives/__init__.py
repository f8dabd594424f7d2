"""What is between rotors and joints at the elastic level: forces of meshes, belts and springs that stretch."""
