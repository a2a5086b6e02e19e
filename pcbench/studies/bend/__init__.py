"""Experiments: questions that a comparison raises, answered on scenes whose truth is known."""
