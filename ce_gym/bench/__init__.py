"""Benchmarks: every figure the project states can be measured again with `python -m ce_gym.bench <name>`.

May import everything else of the package; nothing imports it.
"""
