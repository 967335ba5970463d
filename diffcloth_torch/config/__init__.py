"""Configurations: the schema of YAML files, and what is built from them."""
