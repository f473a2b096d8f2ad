"""Inputs of the stability map: motions and garments beyond the ordinary, and broken files."""
