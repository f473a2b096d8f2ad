"""What a rollout file holds beside the simulated cloth."""
