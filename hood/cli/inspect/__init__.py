"""``hood inspect``: what files are, what is wrong with them, and how to repair it.

It writes nothing.
"""
