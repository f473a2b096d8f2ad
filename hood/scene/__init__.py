"""What is simulated: a garment on a body in motion, where it starts, and what holds it.

It makes start states and obstacles. It takes no step.
"""
