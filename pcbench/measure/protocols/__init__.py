"""Protocols: how a benchmark evaluates a reconstruction, from its files to the numbers that papers quote."""
