"""Pickles and torch files, read without running anything they name.

Only arrays, numbers and text come out. Any class is refused.
"""
