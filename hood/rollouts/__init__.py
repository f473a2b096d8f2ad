"""Trajectories: the loop over frames, checks while it runs, the file that it writes, and the verdict on it.

Everything here works with any stepper.
"""
