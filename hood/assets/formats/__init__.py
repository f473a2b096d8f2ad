"""Readers of mesh and animation files, one format a module.

They return arrays. What the arrays mean is decided later.
"""
