"""Reproduction of Gao et al. 2025, from images on concentric circles to tables, maps and verdicts.

`plan` lists the clouds, `clouds` reconstructs them, `evaluation` compares them with a reference, `results` stores the
results, `sentences`, `table` and `figures` present them; `gao` runs everything.
"""
