"""What ``hood inspect`` says of files, a module for each kind that needs more than a few lines."""
