"""Whether a rollout can be trusted: one rule with its limits, and what the rule measures from the stored frames.

- :mod:`~hood.rollouts.verdict.rule`: from bad frames to sound, unsound or not judged
- :mod:`~hood.rollouts.verdict.causes`: strain, distance from the minimum, crossings; the reasons in sentences
- :mod:`~hood.rollouts.verdict.skin`: skin through the cloth, vertices inside the body
- :mod:`~hood.rollouts.verdict.worn`: where parts of the garment are on the body; ``unworn`` says which have come off
- :mod:`~hood.rollouts.verdict.doubts`: what may be wrong with the input
- :mod:`~hood.rollouts.verdict.surface`, ``distance`` and ``frames``: what these read of stored frames

Limits are in :mod:`hood.limits`. It never changes a rollout: it reads positions and metrics, of a file as of a rollout that
has just ended.
"""
