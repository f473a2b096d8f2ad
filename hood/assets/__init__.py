"""Files become objects: bodies, garments, motions, fabrics.

It reads and checks what people bring. It never simulates, and never runs code that a file names.
"""
