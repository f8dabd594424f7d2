"""Is this robot possible? Checks of bodies, of constraints and of whole robots."""
