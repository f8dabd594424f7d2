"""Which results a change alters."""
