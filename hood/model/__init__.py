"""The network of the paper: features of a step, the hierarchical graph, message passing, and what its output means.

It predicts accelerations of one step. Trajectories are :mod:`hood.rollouts`.
"""
