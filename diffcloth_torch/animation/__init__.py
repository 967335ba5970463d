"""Surfaces over time, in files of other programs."""
