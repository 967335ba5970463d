"""Viewers: each receives the states of a simulation, one after the other."""
