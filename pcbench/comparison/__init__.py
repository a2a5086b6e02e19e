"""Comparison of candidate clouds with a reference, in memory or in tiles.

`request` opens the inputs, `plan` chooses memory or tiles, `pipeline` has the steps that both have in common, and `run`
computes and saves a `Comparison`.
"""
