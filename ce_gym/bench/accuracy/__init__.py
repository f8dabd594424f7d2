"""Time against error."""
