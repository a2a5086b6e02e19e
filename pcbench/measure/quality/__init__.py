"""The quality of one cloud without a reference: sampling, noise, double walls, strips, upright walls.

`quality.measure_quality` returns a `CloudQuality`; each module answers one question and defines its numbers.
"""
