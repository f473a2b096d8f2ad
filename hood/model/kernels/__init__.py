"""Faster forms of message passing: compiled C++ blocks and Triton kernels.

Each is chosen only where it applies, and is tested against the torch form.
"""
