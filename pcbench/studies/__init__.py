"""Questions that are answered by many runs."""
