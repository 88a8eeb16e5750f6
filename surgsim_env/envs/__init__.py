"""Gymnasium environments, their ids, vector environments, and an interface for stable-baselines3."""
