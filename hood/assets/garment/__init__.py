"""Garments: their files, how they are bound to a body, pins, parts, outfits.

A garment is at rest here. Cloth that moves is :mod:`hood.cloth`.
"""
