"""Novel views of scenes: how similar the renderings of a reconstructor are to their photographs.

`runs` collects or renders the views, `scores` measures them, `table` and `pictures` present the results.
"""
