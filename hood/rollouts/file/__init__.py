"""The file of a rollout (HDF5): written frame by frame, read back whole.

Its layout stays: older files are read.
"""
