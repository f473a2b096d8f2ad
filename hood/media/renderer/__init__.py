"""A software renderer of triangle meshes: camera, shading, textures.

The same picture on every machine.
"""
