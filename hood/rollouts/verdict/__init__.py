"""Whether a rollout can be trusted: one rule with its limits, and what the rule measures from the stored frames.

It never changes a rollout: it reads positions and metrics, of a file as of a rollout that has just ended.
"""
