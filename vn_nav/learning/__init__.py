"""Learning: rollouts, returns, losses and the trainer."""
