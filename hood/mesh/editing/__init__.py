"""Meshes changed: repair, seams, thickness, subdivision, remeshing.

Every function returns a new mesh. None reads a file.
"""
