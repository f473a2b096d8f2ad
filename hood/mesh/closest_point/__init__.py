"""The closest point of a surface: search over bounding boxes, in torch and compiled.

The torch form is the reference. Never decides what contact is.
"""
