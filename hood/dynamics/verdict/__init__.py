"""What a rollout is judged by: figures of its steps, and the rule.

A figure says what is so, in units; what follows from it is the rule's affair alone.
"""
