"""Safe model-based reinforcement learning for Stable-Baselines3."""
