"""Sparse structure from motion through pycolmap."""
