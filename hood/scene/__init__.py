"""What a step works on: cloth, state, obstacle, contact; windows of motions for training."""
