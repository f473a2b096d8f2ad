"""Parametric bodies (SMPL, SMPL-X, the embedded one): model files and skinning.

smplx is used in one module alone. A body in motion belongs to :mod:`hood.scene`.
"""
