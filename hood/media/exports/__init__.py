"""Rollouts for other programs: USD, glTF, point caches, mesh sequences.

Positions are written as they are stored.
"""
