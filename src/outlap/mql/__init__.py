"""Meta-Q-Learning with adaptive β clipping, on Stable-Baselines3."""
