"""What is learned: the networks, their training and their use."""
