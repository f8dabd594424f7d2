"""Readers of robot files, one package for each format, and what they share."""
