"""Trainer, curriculum, checkpoints."""
