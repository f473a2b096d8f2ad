"""Training without simulated data: scenes, curriculum, optimiser, checkpoints.

The loss is the potential of :mod:`hood.energies`; no reference trajectory is read.
"""
