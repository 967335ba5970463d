"""How bodies and robots move by themselves, in torch: before a step of the core, and after it."""
