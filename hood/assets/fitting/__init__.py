"""Where a garment belongs on a body, in which unit, and what is suspicious about it.

It moves garments as a whole. Drape is the solver's.
"""
