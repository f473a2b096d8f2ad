"""Motions: sequences of poses and moving meshes."""
