"""What moves: states and controls, the differentiable step between them, and the simulator."""
