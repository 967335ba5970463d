"""The simulated objects: cloths, bodies, robots, scenes, and the options of a simulator."""
