"""``hood envelope``: where each method holds and fails in extreme scenes, as a map."""
