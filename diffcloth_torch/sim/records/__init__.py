"""Records that callers hold: states, controls, parameters, reports and trajectories."""
