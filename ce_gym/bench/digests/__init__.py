"""Digests of results, to compare versions and machines."""
