"""New views of scenes: how like their photographs the renderings of a reconstructor are.

`runs` gets rendered views of scenes, `scores` measures them, `table` and `pictures` show what came of it.
"""
