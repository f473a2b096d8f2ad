"""The multi-level MeshGraphNet: encoder, message passing on every level, decoder.

Never knows what its columns mean.
"""
