"""Minimises the incremental potential without a network: projected Newton, and steps of single vertices.

It solves one step. Sequences of steps are :mod:`hood.rollouts`.
"""
