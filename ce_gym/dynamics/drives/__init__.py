"""Transmissions between rotors and joints: stretches at the elastic level, and loads of motors."""
