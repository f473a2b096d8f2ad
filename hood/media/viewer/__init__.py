"""Rollouts as one HTML page that turns and plays in a browser, without a network.

The page needs no server and loads nothing.
"""
