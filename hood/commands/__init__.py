"""The commands behind ``hood train|rollout|evaluate``: read a config, call the library, print what happened."""
