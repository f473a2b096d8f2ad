"""Integrate, simulate, roll out."""
