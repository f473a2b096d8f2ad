"""The hierarchical graph over a garment and its body edges."""
