"""Readers of mesh and animation files."""
