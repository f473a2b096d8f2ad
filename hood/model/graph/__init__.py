"""The hierarchical graph over a garment, and the edges to the body.

Levels depend on the garment alone and are kept.
"""
