"""Timing, report and machine description of all benchmarks."""
