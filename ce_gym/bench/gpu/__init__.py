"""Agreement and speed on a GPU."""
