"""Meshes without physics: their shapes, checks, poses and files."""
