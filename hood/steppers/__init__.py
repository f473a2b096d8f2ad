"""Ways to take a step, behind one interface: network, solver, network and solver, published weights.

A stepper knows one step; :mod:`hood.rollouts` calls it frame after frame.
"""
