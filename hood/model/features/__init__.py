"""Features of a step: groups of columns that know their width, and normalisation.

They read a step and change nothing.
"""
