"""Functions of the core as operations of torch, with exact derivatives in every mode."""
