"""Motion of bodies and robots by themselves, in torch: before a step of the core and after it."""
