"""Pictures, films, exports and the viewer of simulated clothing, drawn in software: no display, no graphics card.

It reads rollouts and never computes one.
"""
