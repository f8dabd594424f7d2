"""Readers of robot files, one package for each format, and their common functions."""
