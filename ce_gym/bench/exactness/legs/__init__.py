"""Legs on stands: what they have to follow, controllers that know them at a level, and loops of the two."""
