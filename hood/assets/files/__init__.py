"""Names of the embedded assets, and what all readers and writers of files share.

Every write is whole or absent. No format is read here.
"""
