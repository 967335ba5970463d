"""`python -m diffcloth_torch` is `diffcloth`."""

from diffcloth_torch.cli import main

if __name__ == "__main__":
    main(prog_name="diffcloth")
