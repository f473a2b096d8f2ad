"""The connected parts of a scene's garment."""
