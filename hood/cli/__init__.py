"""The command line: reads words, prints, and returns exit codes.

Nothing below imports it.
"""
