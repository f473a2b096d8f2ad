"""``hood tradeoff``: time against accuracy for many settings, as a chart."""
