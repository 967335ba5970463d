"""Optimization of inputs of a simulation; depends on the simulator, not on configurations."""
