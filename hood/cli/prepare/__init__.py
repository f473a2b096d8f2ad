"""``hood prepare``: a garment repaired, fitted to a body, and written for rollouts.

What it writes, ``hood rollout`` reads without a question.
"""
