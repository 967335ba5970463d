"""Static equilibrium and its derivatives."""
