"""Parts that move: states and controls, the differentiable step between them, and the simulator."""

from diffcloth_torch.saved import read_saved_objects

read_saved_objects()
