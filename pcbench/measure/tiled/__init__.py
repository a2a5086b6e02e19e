"""Comparison of clouds that do not fit into memory: the same numbers, computed tile by tile."""
