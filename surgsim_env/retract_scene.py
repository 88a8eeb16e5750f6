"""Which scene a retraction takes: the one that is named, or the one of the same organ that it names."""

from pathlib import Path

from surgsim_env.scenes import Scene, load_scene, make_scene


def make_retract_scene(name: str | Path) -> Scene:
    """The scene of a name or path that a retraction takes: it, or the one of the same organ that it names.

    Raises:
        ValueError: what `make_scene` raises; a scene that says why its organ is not retracted.
    """
    scene = make_scene(name)
    if scene.retract is not None or (scene.retract_scene is None and scene.retract_refusal is None):
        return scene
    if scene.retract_scene is None:
        raise ValueError(f"scene {scene.name!r} cannot be retracted: {scene.retract_refusal}")
    return load_scene(scene.folder / scene.retract_scene)
