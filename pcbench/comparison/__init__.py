"""Comparison of candidate clouds with a reference: what is compared, in memory or in tiles, and what is written.

`request` opens the inputs, `plan` chooses memory or tiles, `pipeline` has the steps that both have in common, and `run`
computes and saves a `Comparison`.
"""
