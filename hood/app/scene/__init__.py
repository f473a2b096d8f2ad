"""Settings of a scene: garments, motion, fabrics, fasteners, events.

They return objects of :mod:`hood.scene`.
"""
