"""Applications of surgsim_env, a folder each: each imports only names that the engine exports."""
