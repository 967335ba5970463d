"""Viewers: what becomes of the states of a simulation. Each is shown one state after the other."""
