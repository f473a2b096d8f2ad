"""Checks while a rollout runs, and repairs of single steps.

A check that finds something says so in the file. Nothing is mended silently.
"""
