"""Where the results of many motions go, so that no two of them meet in one place."""
