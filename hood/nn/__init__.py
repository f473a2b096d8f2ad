"""The multi-level MeshGraphNet."""
