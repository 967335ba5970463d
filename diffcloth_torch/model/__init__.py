"""What is simulated: cloths, bodies and the scene of them, and the options of a simulator."""
