"""Reconstructors on perturbed photographs of a city with exact truth."""
