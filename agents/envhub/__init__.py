"""Environments of LeRobot's EnvHub: `env.py` is uploaded to a repository of the Hugging Face Hub."""
