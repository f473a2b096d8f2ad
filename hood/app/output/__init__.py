"""Settings of what is written: frame rate, formats, textures, summary, verdict.

Simulation is over, or untouched, here.
"""
