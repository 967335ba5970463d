"""Quantities of a state: energy, momentum, poses and velocities of links, wrenches."""
