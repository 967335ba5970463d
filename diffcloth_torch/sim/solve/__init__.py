"""One step of a scene on checked fields: cores, couplings and failures."""
