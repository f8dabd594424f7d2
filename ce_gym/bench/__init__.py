"""Benchmarks: every figure the project states can be measured again with `python -m ce_gym.bench <name>`."""
