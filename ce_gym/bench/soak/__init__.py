"""Minutes of steps that must not fail, leak or be torn."""
