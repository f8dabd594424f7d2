"""Files and calls at random: what must never break, whatever is tried."""
