"""The layouts in which motions of people are published, and how each becomes joint rotations and a translation."""
