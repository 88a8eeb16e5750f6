"""Gymnasium environments, their ids, vector environments, and interfaces for PettingZoo and stable-baselines3."""
