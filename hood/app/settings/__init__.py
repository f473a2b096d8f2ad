"""Settings: YAML and ``key=value`` words become one checked config.

Hydra is used here alone.
"""
