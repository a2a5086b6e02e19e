"""Measurements between a reference and its candidates."""
