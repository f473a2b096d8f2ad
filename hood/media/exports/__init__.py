"""Rollouts for other programs."""
