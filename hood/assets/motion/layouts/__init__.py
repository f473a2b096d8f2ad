"""The layouts in which motions of people are published, and how each becomes joint rotations and a translation.

A layout is recognised by its keys and shapes, never by a file's name.
"""
