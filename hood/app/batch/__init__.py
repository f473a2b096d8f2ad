"""Many motions with one set of settings: a folder for each, resumed where it was.

Two motions never share a folder.
"""
