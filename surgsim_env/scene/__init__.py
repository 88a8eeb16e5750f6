"""Scenes as data: scene files, arm files, the anatomy of a scene, its palpable surface, levels of difficulty."""
