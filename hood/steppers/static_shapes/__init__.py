"""A step whose tensors keep their shapes, to be captured as a CUDA graph.

hood/studies/notes/gpu.md says what of it was shown on a GPU, and what was not.
"""
