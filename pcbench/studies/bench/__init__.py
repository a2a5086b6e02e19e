"""Reconstructors side by side on one scene: time and memory against accuracy.

`plan` says what is run, `runs` runs and keeps it, `score` measures each cloud, `pareto` says which is worth its time.
"""
