"""What a network's output becomes: positions, by acceleration, by edges, with local corrections.

No solver iteration of the whole cloth runs here.
"""
