"""The paper, reproduced: Gao et al. 2025 from images on concentric circles to its tables, maps and verdicts.

`plan` says what is made, `clouds` makes it, `held` compares it with a reference, `results` keeps what came of it,
`sentences`, `table` and `figures` show it; `gao` does all of it.
"""
