"""Training of networks: data, augmentation, losses, checkpoints."""
