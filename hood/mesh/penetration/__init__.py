"""Where meshes pass through each other: pairs of crossing triangles, and how deep.

It measures and never moves a vertex.
"""
