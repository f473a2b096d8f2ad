"""Sewing patterns: read, checked, meshed, and their panels welded along the stitches.

Nothing here moves cloth: :mod:`hood.rollouts.sewing` does.
"""
