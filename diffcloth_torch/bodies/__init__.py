"""How rigid bodies move."""
