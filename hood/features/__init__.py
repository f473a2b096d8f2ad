"""Features of a step: groups that know their width, and normalisation."""
