"""Minimises the incremental potential without a network: projected Newton, and local sweeps."""
