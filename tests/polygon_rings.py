"""Closed rings for tests of regions: a square, a hole in it, and a square beside it."""

SQUARE = [[0, 0], [4, 0], [4, 4], [0, 4], [0, 0]]
HOLE = [[1, 1], [1, 3], [3, 3], [3, 1], [1, 1]]
SEPARATE_SQUARE = [[6, 0], [8, 0], [8, 2], [6, 2], [6, 0]]
