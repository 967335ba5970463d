"""The command line `diffcloth`: one module for each command, which `main` imports on use."""

from diffcloth_torch.cli.main import main

__all__ = ["main"]
