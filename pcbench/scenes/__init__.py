"""Photographs with cameras: read from folders, or made with exact truth."""
