"""Files and objects: bodies, garments, motions, fabrics."""
