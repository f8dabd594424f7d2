"""What every benchmark shares: timing, the report, progress and the machine it ran on."""
