"""Garments: their files, how they are bound to a body, and checks of both."""
