"""Benchmarks; `python -m ce_gym.bench <name>` measures the numbers in the documentation."""
