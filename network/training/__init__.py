"""How a network is trained: material, augmentation, losses, checkpoints."""
