"""What a garment's file holds: objects, thick cloth, pattern pieces, buttons, several garments, a body.

It turns a file that is not one sheet into garments of one sheet, and records what it did.
"""
