"""Pickles and torch files, read without running anything they name."""
