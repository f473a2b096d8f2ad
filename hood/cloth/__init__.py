"""Cloth of a simulation: rest shape, masses, fabric, and its state in time.

Plain tensors. Nothing here finds contact or takes a step.
"""
