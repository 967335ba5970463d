"""Viewers: each receives the states of a simulation in the order of time."""
