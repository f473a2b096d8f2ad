"""Studies of methods: plans, the chart of speed against accuracy, the stability map.

They use the whole package, and nothing else imports them. Their commands are registered as those of a plugin are.
"""
