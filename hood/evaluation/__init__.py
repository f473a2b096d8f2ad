"""Metrics, validation rollouts, tables."""
