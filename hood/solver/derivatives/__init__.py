"""Gradient and curvature of every energy in closed form, gathered for the solver.

Each form is tested against torch's derivatives of the energy itself.
"""
