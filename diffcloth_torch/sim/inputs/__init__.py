"""Inputs of a step: checked, complete, and with a leading axis of environments."""
