"""Reconstructors side by side on one scene: time and memory against accuracy.

`plan` lists the runs, `runs` executes and stores them, `score` evaluates each cloud, `pareto` finds the Pareto front.
"""
