"""Configurations: the schema of YAML files, and the objects built from them."""
