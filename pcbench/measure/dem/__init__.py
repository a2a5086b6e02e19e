"""Differences of elevation models: what changed between epochs, how much, and with which uncertainty."""
