"""Motions: sequences of poses and moving meshes, from files of the field.

A unit, a frame rate or an axis that a file does not say is a doubt, never a silent guess.
"""
