"""Geometry on triangle meshes: topology, closest points, penetration, repair and remeshing.

Never knows what a mesh is of: garments, bodies and their files come later.
"""
