"""Bodies in motion: posed body models and moving meshes, at any time.

They are obstacles with a velocity. Cloth never moves them.
"""
