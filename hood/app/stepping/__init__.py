"""Settings of a stepper: which one, its refinement, guard and contact of cloth, and what to warn of.

They return objects of :mod:`hood.steppers`.
"""
