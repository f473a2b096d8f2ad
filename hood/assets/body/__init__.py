"""Parametric bodies: model files, skinning."""
